"""Which descriptors are each other's nearest, beside the definition."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.matching.xfeat import mutual_nearest


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_pairs_are_those_that_are_each_others_nearest(count: int, other_count: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    first, second = (
        torch.nn.functional.normalize(torch.randn(n, 8, generator=generator), dim=1) for n in (count, other_count)
    )
    in_first, in_second, cosine = mutual_nearest(first, second)
    cosines = (first @ second.T).numpy()
    pairs = {
        (i, j)
        for i in range(count)
        for j in range(other_count)
        if cosines[i].argmax() == j and cosines[:, j].argmax() == i
    }
    assert set(zip(in_first.tolist(), in_second.tolist(), strict=True)) == pairs
    np.testing.assert_allclose(cosine.numpy(), cosines[in_first, in_second])


def test_equal_descriptors_share_their_nearest() -> None:
    axes = torch.eye(4)
    in_first, in_second, _ = mutual_nearest(axes[[0, 0, 1]], axes[[2, 0, 0, 1]])
    assert list(zip(in_first.tolist(), in_second.tolist(), strict=True)) == [(0, 1), (1, 1), (2, 3)]
