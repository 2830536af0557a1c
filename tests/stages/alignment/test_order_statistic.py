"""The compiled order statistic, as numpy has it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fieldpose.stages.alignment.least_squares import order_statistic

VALUES = st.one_of(st.floats(0, 1e6), st.sampled_from([0.0, 1.0, np.inf]))


@given(arrays(np.float64, st.integers(1, 60), elements=VALUES), st.data())
def test_as_a_partition_has_it(values: np.ndarray, data: st.DataObject) -> None:
    k = data.draw(st.integers(0, len(values) - 1))
    before = values.copy()
    assert order_statistic(values, k) == np.partition(values, k)[k]
    np.testing.assert_array_equal(values, before)
