import os
from collections.abc import Iterator

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fieldpose.stages.nerf import workers
from fieldpose.stages.nerf.blas import SingleThreadedBlas
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.workers import Workers


@pytest.fixture(autouse=True)
def two_blas_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever renderers other tests still hold."""
    monkeypatch.setattr(workers, "BLAS", SingleThreadedBlas())
    with threadpool_limits(limits=2, user_api="blas"):
        yield


def blas_threads() -> set[int]:
    np.ones((2, 2)) @ np.ones((2, 2))
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def some_workers() -> Workers:
    return Workers(FieldConfig(), 2, packet=8, rows=32, backward=False)


def test_blas_has_one_thread_until_the_last_workers_are_closed() -> None:
    first, second = some_workers(), some_workers()
    assert blas_threads() == {1}
    first.close()
    first.close()
    assert blas_threads() == {1}
    second.close()
    assert blas_threads() == {2}
    third = some_workers()
    assert blas_threads() == {1}
    third.close()
    assert blas_threads() == {2}


def test_workers_that_nobody_closes_give_blas_back_as_well() -> None:
    kept = some_workers()
    assert kept.each(10, 3, lambda scratch, first, last: last - first) == [3, 3, 3, 1]
    assert blas_threads() == {1}
    del kept
    assert blas_threads() == {2}


def test_as_many_threads_as_the_process_may_use_cores() -> None:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert Workers(FieldConfig(), 0, 8, 16, backward=False).threads == 1
    finally:
        os.sched_setaffinity(0, before)
