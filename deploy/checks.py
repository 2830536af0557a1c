"""What `fieldpose doctor` looks at: each check says what it found, and how to mend what is not well."""

from __future__ import annotations

import platform
import socket
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import psutil

from fieldpose.bus import shared_memory
from fieldpose.errors import FieldposeError
from fieldpose.stages.cores import usable_cores

_PACKAGES = ("torch", "kornia", "numba", "numpy", "opencv-python-headless", "eclipse-zenoh", "mcap", "supervisor")
_NEEDED_GB = 3.0
_DEFAULT_PORT = 7447
_ECHOES = 20
_ECHO_BYTES = 1 << 20
_SLOW_ECHO_MS = 20.0
Status = Literal["ok", "note", "warning", "failed"]


@dataclass(frozen=True)
class Finding:
    """`failed` keeps fieldpose from working, `warning` makes it work less well, `note` takes something optional."""

    what: str
    status: Status
    detail: str
    mend: str = ""


Check = Callable[[], Iterator[Finding]]


def machine() -> Iterator[Finding]:
    """Processor and memory."""
    cores = usable_cores()
    text = f"{platform.system()} {platform.machine()}, {cores} cores"
    yield Finding(
        "machine", "ok" if cores > 1 else "warning", text, "" if cores > 1 else "two cores or more are faster"
    )
    memory = psutil.virtual_memory()
    enough = memory.available / 2**30 >= _NEEDED_GB
    text = f"{memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GB free"
    yield Finding("memory", "ok" if enough else "warning", text, "" if enough else f"{_NEEDED_GB:g} GB are needed")
    hindrance = shared_memory.hindrance()
    if hindrance is not None:
        yield Finding("shared memory", "note", "images between processes go over TCP", hindrance)
        return
    yield Finding("shared memory", "ok", f"{shared_memory.free_bytes() / 2**20:.0f} MB free in {shared_memory.FOLDER}")


def packages() -> Iterator[Finding]:
    """Python and the packages that matter most."""
    yield Finding("python", "ok", platform.python_version())
    for name in _PACKAGES:
        try:
            yield Finding(name, "ok", metadata.version(name))
        except metadata.PackageNotFoundError:
            yield Finding(name, "failed", "not installed", "`make install`")


def bus() -> Iterator[Finding]:
    """A hub, two processes' worth of sessions, and a megabyte there and back."""
    try:
        median_ms = statistics.median(_round_trips_ms())
        slow = median_ms > _SLOW_ECHO_MS
        yield Finding("bus", "warning" if slow else "ok", f"1 MB there and back through the hub: {median_ms:.1f} ms")
    except FieldposeError as error:
        yield Finding("bus", "failed", str(error), "is the loopback interface up, or a firewall in the way?")
    with socket.socket() as probe:
        taken = probe.connect_ex(("127.0.0.1", _DEFAULT_PORT)) == 0
    detail = "somebody listens there, a hub perhaps" if taken else "free"
    yield Finding(f"port {_DEFAULT_PORT}", "note" if taken else "ok", detail)


def weights() -> Iterator[Finding]:
    """Whether each matcher can be had, and how long it takes to load."""
    from fieldpose.stages.matching.core import MATCHERS, MatchingConfig, build_matcher

    default = MatchingConfig().matcher
    for name in MATCHERS:
        began = time.perf_counter()
        try:
            build_matcher(MatchingConfig(matcher=name))
        except FieldposeError as error:
            yield Finding(f"matcher {name}", "failed" if name == default else "note", str(error))
        else:
            yield Finding(f"matcher {name}", "ok", f"loaded in {time.perf_counter() - began:.1f} s")


def kernels() -> Iterator[Finding]:
    """Whether the field's kernels are compiled already."""
    from fieldpose.stages.kernel_cache import cache_folder
    from fieldpose.stages.nerf import kernels

    folder = cache_folder(Path(kernels.__file__).parent)
    if folder is None:
        mend = "every process compiles them; set NUMBA_CACHE_DIR to a folder that can be written to"
        yield Finding("kernels", "note", "no folder can be written to that they could be kept in", mend)
        return
    compiled = len(list(folder.rglob("*.nbi")))
    detail = f"{compiled} compiled, in {folder}" if compiled else "not compiled yet"
    mend = "" if compiled else "the first start takes half a minute longer"
    yield Finding("kernels", "ok" if compiled else "note", detail, mend)


def backend() -> Iterator[Finding]:
    """By what fields are rendered and learnt here."""
    from fieldpose.stages.nerf.backend import resolved

    chosen = resolved("auto")
    if chosen == "cuda":
        import torch

        yield Finding("backend", "ok", f"cuda: {torch.cuda.get_device_name()}")
    else:
        yield Finding("backend", "ok", "numba: compiled kernels on the CPU, as no CUDA device is found")


def demo_scene() -> Iterator[Finding]:
    """Whether the embedded scene is there."""
    from fieldpose.deploy.scene import demo_file

    for name in ("field.safetensors", "sequence.mcap"):
        try:
            yield Finding(f"demo {name}", "ok", str(demo_file(name)))
        except FieldposeError as error:
            yield Finding(f"demo {name}", "note", "not there", str(error))


def field(path: Path) -> Iterator[Finding]:
    """Whether a field can be loaded."""
    from fieldpose.stages.nerf.field import load_field

    try:
        found = load_field(path)
    except FieldposeError as error:
        yield Finding("field", "failed", str(error))
        return
    about = found.metadata
    quality = "not measured" if about.psnr_db is None else f"{about.psnr_db:.1f} dB"
    yield Finding("field", "ok", f"{path}: {about.dataset_kind}, {len(about.cameras)} training views, {quality}")
    if about.accuracy is not None:
        from fieldpose.deploy.evaluation.accuracy import in_words

        yield Finding("field", "ok", in_words(about.accuracy))
    if about.camera_fit is not None:
        from fieldpose.deploy.cameras import in_words as fit_in_words

        fits = about.camera_fit.verdict in ("fit", "adjusted")
        yield Finding("field", "ok" if fits else "note", fit_in_words(about.camera_fit, about.unit))
    if found.descriptors is None:
        told = "it does not remember how its training views look: searches take longer, and estimate needs a guess"
        yield Finding("field", "note", told, "train it again")


def _round_trips_ms() -> list[float]:
    from fieldpose.deploy.benchmarks import echo
    from fieldpose.errors import TransportError

    with echo.hub() as endpoint, echo.session(endpoint) as here, echo.session(endpoint) as there:
        echo.answer(there)
        sender = echo.Echo(here)
        trips = [sender.round_trip_ms(_ECHO_BYTES) for _ in range(_ECHOES)]
    came = [ms for ms in trips if ms is not None]
    if len(came) < len(trips):
        raise TransportError(f"{len(trips) - len(came)} of {len(trips)} messages did not come back over the bus")
    return came
