"""Kernels held to fewer instructions than the processor has, in a process of their own."""

import os
from collections.abc import Callable

import numpy as np
import pytest
from numba import njit

from fieldpose.deploy.benchmarks.isa import instruction_set, limited_to


@njit
def doubled(values: np.ndarray) -> np.ndarray:
    return 2.0 * values + 1.0


def compiled(count: int, report: Callable[[str], None]) -> tuple[str, bool, int]:
    """The instruction set, whether the widest registers are used, and the process."""
    report("compiling")
    doubled(np.ones(count))
    return instruction_set(), "zmm" in "".join(doubled.inspect_asm().values()), os.getpid()


def test_avx2_is_kept_to_in_a_process_of_its_own() -> None:
    said: list[str] = []
    before = dict(os.environ)
    try:
        name, wide, process = limited_to("avx2", compiled, 4096, said.append)
    except Exception as error:
        if "has no AVX2" in str(error):
            pytest.skip(str(error))
        raise
    assert (name, wide) == ("AVX2", False)
    assert process != os.getpid()
    assert dict(os.environ) == before
    assert said == []


def test_natively_it_is_called_here() -> None:
    said: list[str] = []
    name, _, process = limited_to("native", compiled, 64, said.append)
    assert (name, process) == (instruction_set(), os.getpid())
    assert said == ["compiling"]
