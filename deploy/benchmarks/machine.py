"""What this machine can do at most, measured: the yardsticks that kernels are held against."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from numba import njit
from threadpoolctl import threadpool_limits

from fieldpose.stages.cores import usable_cores
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.kernels.layers import layer
from fieldpose.stages.nerf.kernels.types import SH_SIZE

_ROWS = 256
_READS = 1 << 21
_REPEATS = 5


@dataclass(frozen=True)
class Limits:
    """Rates of all cores together.

    `multiply_adds_per_s`: of float32 matrix products as small as a density network's layers, by BLAS or by the
    renderer's own loops, whichever is faster here; `reads_per_s`: of rows of 8 bytes at random places of a table.
    """

    multiply_adds_per_s: float
    reads_per_s: float

    def seconds(self, config: FieldConfig, samples: int, rays: int) -> float:
        """The least time for so many samples, and rays that meet any: the networks' arithmetic and the tables' rows."""
        inputs = config.levels * config.level_features
        density = inputs * config.hidden + config.hidden * (1 + config.features)
        wide = config.colour_hidden
        colour = (config.features + SH_SIZE) * wide + wide * wide + 3 * wide
        arithmetic = (samples * density + rays * colour) / self.multiply_adds_per_s
        return arithmetic + samples * config.levels * 8 / self.reads_per_s


def limits(config: FieldConfig, table_rows: int) -> Limits:
    """Measure both rates with as many threads as there are cores."""
    threads = cores()
    with ThreadPoolExecutor(threads) as pool, threadpool_limits(limits=1, user_api="blas"):
        return Limits(_multiply_adds(config, pool, threads), _reads(table_rows, pool, threads))


def cores() -> int:
    """Cores that this process may use."""
    return usable_cores()


def describe() -> str:
    """Processor, cores and memory in words."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        named = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = named[0].split(":", 1)[1].strip() if named else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{cores()} cores of {model}, {memory:.0f} GiB"


def _multiply_adds(config: FieldConfig, pool: ThreadPoolExecutor, threads: int) -> float:
    inputs = config.levels * config.level_features
    left = np.random.default_rng(0).random((_ROWS, inputs), dtype=np.float32)
    right = np.random.default_rng(1).random((inputs, config.hidden), dtype=np.float32)
    products = 2000

    def best(by: Callable[[np.ndarray, np.ndarray, int], float]) -> float:
        return _best_time(pool, threads, lambda _: by(left, right, products))

    return threads * products * _ROWS * inputs * config.hidden / min(best(_products), best(_layers))


def _reads(table_rows: int, pool: ThreadPoolExecutor, threads: int) -> float:
    table = np.random.default_rng(0).random(table_rows)
    places = [np.random.default_rng(i).integers(0, table_rows, _READS, dtype=np.uint32) for i in range(threads)]
    return threads * _READS / _best_time(pool, threads, lambda i: _sum_of_reads(table, places[i]))


def _best_time(pool: ThreadPoolExecutor, threads: int, work: Callable[[int], object]) -> float:
    times = []
    for _ in range(_REPEATS + 1):  # the first also compiles
        began = time.perf_counter()
        list(pool.map(work, range(threads)))
        times.append(time.perf_counter() - began)
    return min(times[1:])


@njit(nogil=True)
def _products(left: np.ndarray, right: np.ndarray, count: int) -> float:
    out = np.empty((left.shape[0], right.shape[1]), np.float32)
    for _ in range(count):
        np.dot(left, right, out)
    return out[0, 0]


@njit(nogil=True)
def _layers(left: np.ndarray, right: np.ndarray, count: int) -> float:
    out = np.empty((left.shape[0], right.shape[1]), np.float32)
    for _ in range(count):
        layer(left, right, np.float32(-np.inf), np.int64(0), np.int64(left.shape[0]), out)
    return out[0, 0]


@njit(nogil=True, fastmath=True)
def _sum_of_reads(table: np.ndarray, places: np.ndarray) -> float:
    total = 0.0
    for i in range(places.shape[0]):
        total += table[places[np.uint64(i)]]
    return total


def cpu_s(process: psutil.Process) -> float:
    """Seconds of processor time that a process has used."""
    times = process.cpu_times()
    return float(times.user + times.system)
