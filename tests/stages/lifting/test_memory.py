"""What is remembered of pixels' consistency."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.lifting.core import ConsistencyMemory, LiftingConfig, lift


@given(st.lists(st.tuples(st.sampled_from("abc"), st.lists(st.integers(0, 30), max_size=12)), max_size=12))
@settings(max_examples=50, deadline=None)
def test_each_pixel_of_a_view_is_looked_at_once(questions: list[tuple[str, list[int]]]) -> None:
    memory, looked = ConsistencyMemory(views=3), set()
    for view, numbers in questions:
        pixels = np.array([(n + 0.25, -n) for n in numbers], np.float32).reshape(-1, 2)

        def look(index: np.ndarray, view: str = view, numbers: list[int] = numbers) -> np.ndarray:
            asked = [(view, numbers[i]) for i in index]
            assert len(set(asked)) == len(asked)
            assert not looked & set(asked)
            looked.update(asked)
            return np.array([ord(view) + n for _, n in asked], np.float32)

        np.testing.assert_array_equal(memory.of(view)(pixels, look), [ord(view) + n for n in numbers])


@pytest.mark.parametrize(("views", "looked_at"), [(2, "abcb"), (0, "abacab")])
def test_the_longest_unused_view_is_forgotten(views: int, looked_at: str) -> None:
    memory, pixels = ConsistencyMemory(views), np.zeros((1, 2), np.float32)
    calls: list[str] = []

    def ask(view: str) -> None:
        memory.of(view)(pixels, lambda index: calls.append(view) or np.zeros(len(index)))  # type: ignore[func-returns-value]

    for view in "abacab":
        ask(view)
    assert calls == list(looked_at)


def test_a_view_that_comes_again_is_lifted_alike_without_the_renderer() -> None:
    scene, lens, pose = AnalyticScene(), camera(120), viewpoint()
    view = scene.render_view(lens, pose)
    pixels = lens.grid()[view.opacity.ravel() > 0.5][::50].astype(np.float32)
    memory, config = ConsistencyMemory(), LiftingConfig()

    def lifted(renderer: AnalyticScene | None) -> np.ndarray:
        rng = np.random.default_rng(0)
        found = lift(renderer, view.depth, view.opacity, lens, pose, pixels, rng, config, memory.of("view"))  # type: ignore[arg-type]
        return np.column_stack([found.points_in_object, found.consistency, found.kept])

    np.testing.assert_array_equal(lifted(scene), lifted(None))
