from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.last_used import LastUsed


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 4), st.lists(st.sampled_from(["a", "b", "c", "d", "e", None]), max_size=30))
def test_values_are_made_again_only_once_forgotten(capacity: int, keys: list[str | None]) -> None:
    kept: LastUsed[tuple[str | None, int]] = LastUsed(capacity)
    recent: list[tuple[str, int]] = []
    for i, key in enumerate(keys):
        known = next((value for name, value in recent if name == key), None)
        value = kept.get(key, lambda key=key, i=i: (key, i))  # type: ignore[misc]
        assert value == (key, i if known is None else known)
        if key is not None:
            recent = [entry for entry in recent if entry[0] != key] + [(key, value[1])]
            recent = recent[max(len(recent) - capacity, 0) :]
