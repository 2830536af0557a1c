"""Whatever stands in the files of a dataset, it is read or refused in one line, never by another error."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.tum import CAMERAS

CAMERA = made.centred(32, 24, 30.0)


def scene(root: Path) -> None:
    for sequence in ("seq-01", "seq-02"):
        recorded.write_seven_scenes(root / sequence, CAMERA, 2)
    recorded.text(root / "TrainSplit.txt", "sequence1\n")
    recorded.text(root / "TestSplit.txt", "sequence2\n")


KINDS: dict[str, tuple[Callable[[Path], object], tuple[str, ...], str]] = {
    "transforms": (lambda r: made.write_transforms(r, CAMERA, 3), ("transforms.json",), "."),
    "7scenes": (scene, ("seq-01/frame-000001.pose.txt", "TrainSplit.txt", "TestSplit.txt"), "."),
    "tum": (
        lambda r: recorded.write_tum(r, CAMERAS["3"].resized(32, 24), 3),
        ("groundtruth.txt", "rgb.txt", "depth.txt"),
        ".",
    ),
    "bop": (lambda r: recorded.write_bop(r, CAMERA, 3), ("scene_camera.json", "scene_gt.json"), "obj_000005"),
    "record3d": (lambda r: recorded.write_record3d(r, CAMERA, 4, each=True), ("metadata.json",), "."),
    "record3d of one camera": (lambda r: recorded.write_record3d(r, CAMERA, 4), ("metadata.json",), "."),
    "polycam": (lambda r: recorded.write_polycam(r, CAMERA, 2), ("keyframes/corrected_cameras/1007.json",), "."),
}
HOSTILE = (
    b"", b"nan", b"-Infinity", b"1e999", b"-1e308", b"1e-320", b"9" * 400, b"0", b"-1", b"2", b"1e160", b"null",
    b"true", b'"x"', b"x", b"[]", b"{}", b"[[]]", b",", b"\n", b"#", b" ", b"\x00", b"\xff", b"../..", b"/", b"e",
    b"sequence1", b'"0"', b"[" * 5000,
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    write, files, place = KINDS[kind]
    root = tmp_path / "freiburg3"
    write(root)
    load_dataset(root / place, "all")
    whole = {name: (root / name).read_bytes() for name in files}

    @settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
    @given(
        st.sampled_from(files),
        st.lists(st.tuples(st.floats(0, 1), st.booleans(), st.sampled_from(HOSTILE)), min_size=1, max_size=3),
    )
    def check(name: str, changes: list[tuple[float, bool, bytes]]) -> None:
        content = whole[name]
        for share, one_word, wrong in changes:
            words = [match.span() for match in re.finditer(rb"[^\s,:\[\]{}]+", content)] or [(0, 0)]
            first, end = words[min(int(share * len(words)), len(words) - 1)]
            content = content[:first] + wrong + content[end if one_word else min(end + 40, len(content)) :]
        (root / name).write_bytes(content)
        said = f"{root}"
        try:
            load_dataset(root / place, "all")
        except DatasetError as error:
            said = str(error)
        finally:
            (root / name).write_bytes(whole[name])
        assert str(root) in said
        assert "\n" not in said

    check()
