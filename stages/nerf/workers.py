"""Threads that share a kernel's rays, each with scratch memory of its own."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count
from threading import Lock

import numpy as np

from fieldpose.stages.cores import usable_cores
from fieldpose.stages.nerf.blas import SingleThreadedBlas
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.kernels.ahead import ABREAST
from fieldpose.stages.nerf.kernels.plan import LANES
from fieldpose.stages.nerf.kernels.types import SH_SIZE, Rays, Samples
from fieldpose.stages.nerf.kernels.vectors import BLOCK

BLAS = SingleThreadedBlas()


def new_samples(config: FieldConfig, rows: int, backward: bool) -> Samples:
    """Scratch for `rows` samples; the arrays of the backward pass are empty unless asked for."""
    inputs, outputs = config.levels * config.level_features, 1 + config.features

    def array(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    gradient_rows = rows if backward else 0
    return Samples(
        y=array(rows, 3),
        u=array(3, rows + LANES),
        t=array(rows),
        dt=array(rows),
        ray=np.zeros(rows, np.int32),
        previous=np.zeros(rows, np.int32),
        x=array(rows, inputs),
        h=array(rows, config.hidden),
        out=array(rows, outputs),
        weight=array(rows),
        trans=array(rows),
        dx=array(gradient_rows, inputs),
        dh=array(gradient_rows, config.hidden),
        dout=array(gradient_rows, outputs),
        corner_rows=np.zeros(8 * BLOCK, np.uint32),
        corner_weights=array(8 * BLOCK),
    )


def new_rays(config: FieldConfig, count: int) -> Rays:
    """Scratch for a packet of `count` rays."""
    width, hidden = config.features + SH_SIZE, config.colour_hidden

    def array(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    return Rays(
        lines=array(9, count + ABREAST),
        t=array(count + ABREAST),
        far=array(count + ABREAST),
        trans=array(count),
        last=np.zeros(count, np.int32),
        alive=np.zeros(count + ABREAST, np.bool_),
        sums=array(count, 1 + config.features),
        feats=array(count, width),
        opacity=array(count),
        depth=array(count),
        median=array(count),
        h1=array(count, hidden),
        h2=array(count, hidden),
        rgb=array(count, 3),
        dfeats=array(count, width),
        dh1=array(count, hidden),
        dh2=array(count, hidden),
        drgb=array(count, 3),
        dopacity=array(count),
        ddepth=array(count),
    )


@dataclass
class Scratch:
    """What one thread writes to; `index` tells the threads apart."""

    index: int
    samples: Samples
    rays: Rays


class Workers:
    """A pool of `threads` (0: one a core); kernels release the interpreter lock, so plain threads run them.

    The matrix products inside the kernels then must not start threads of their own: BLAS is held to one, until the
    workers are closed or garbage collected.
    """

    def __init__(self, config: FieldConfig, threads: int, packet: int, rows: int, backward: bool):
        self.threads = threads or usable_cores()
        self._release_blas = BLAS.hold(self)
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self.scratch = [
            Scratch(i, new_samples(config, rows, backward), new_rays(config, packet)) for i in range(self.threads)
        ]

    def each(self, total: int, chunk: int, work: Callable[[Scratch, int, int], object]) -> list[object]:
        """Call work(scratch, first, last) over chunks of range(total), taken by the threads as they come free."""
        starts = count(0, chunk)
        lock = Lock()

        def run(scratch: Scratch) -> list[object]:
            results: list[object] = []
            while True:
                with lock:
                    first = next(starts)
                if first >= total:
                    return results
                results.append(work(scratch, first, min(first + chunk, total)))

        if self._pool is None or total <= chunk:
            return run(self.scratch[0])
        return [item for part in self._pool.map(run, self.scratch) for item in part]

    def split(self, total: int, work: Callable[[Scratch, int, int], object]) -> list[object]:
        """Call work once a thread, over equal parts of range(total): the same split every time."""
        bounds = [total * i // self.threads for i in range(self.threads + 1)]
        parts = [(s, bounds[s.index], bounds[s.index + 1]) for s in self.scratch]
        if self._pool is None:
            return [work(*parts[0])]
        return list(self._pool.map(lambda part: work(*part), parts))

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
        self._release_blas()
