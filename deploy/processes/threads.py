"""Holding a process to its budget of threads, in libraries that may have been imported long before it was known."""

from __future__ import annotations

import os
import sys

from threadpoolctl import threadpool_limits

from fieldpose.deploy.graph import thread_environment


def hold_to(threads: int) -> None:
    """Have each numeric library use so many threads; those that are imported later read the environment."""
    os.environ.update(thread_environment(threads))
    threadpool_limits(limits=threads)
    import cv2

    cv2.setNumThreads(threads)
    if "torch" in sys.modules:
        import torch

        torch.set_num_threads(threads)
    if "numba" in sys.modules:
        import numba

        numba.config.reload_config()
