"""Which of the processor's instructions the kernels use, and holding them to fewer."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal

from fieldpose.errors import UsageError

Isa = Literal["native", "avx2"]

_AVX2 = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+64bit,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+lzcnt,+movbe",
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
}
"""What the libraries read when they are loaded: numba, the matrix products that its kernels call, torch."""


def instruction_set() -> str:
    """The widest vectors that kernels compiled in this process use, in words."""
    import numba
    from llvmlite import binding  # type: ignore[import-untyped]

    if numba.config.CPU_FEATURES:
        features = {name[1:] for name in numba.config.CPU_FEATURES.split(",") if name.startswith("+")}
    else:
        features = {name for name, there in binding.get_host_cpu_features().items() if there}
    named = (("avx512f", "AVX-512"), ("avx2", "AVX2"), ("avx", "AVX"), ("sse4.2", "SSE4.2"), ("neon", "NEON"))
    return next((words for name, words in named if name in features), "no vectors that are known here")


def limited_to(isa: Isa, work: Callable[..., Any], *arguments: Any) -> Any:
    """work(*arguments, report), in a process of its own where the instructions are limited: there nothing is reported.

    The last argument is what reports. Raises UsageError where the machine lacks the instructions.
    """
    if isa == "native":
        return work(*arguments)
    from llvmlite import binding

    host = binding.get_host_cpu_features()
    if not (host.get("avx2", False) and host.get("fma", False)):
        raise UsageError("--isa avx2: this processor has no AVX2; leave the option out")
    spawn = multiprocessing.get_context("spawn")
    with _environment(_AVX2), ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(work, *arguments[:-1], _silent).result()


def _silent(_: str) -> None:
    pass


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
