"""`fieldpose edit` end to end: what it writes is read as any sequence is, and mistakes leave nothing behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import sequences

from fieldpose.bus.messages import Encoding
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.deploy.cli import main
from fieldpose.deploy.evaluation.edited import read_edit, read_visibility
from fieldpose.deploy.evaluation.edits import EDITS
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import RecordingError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.sources import open_source


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sequences.write(tmp_path_factory.mktemp("sequence") / "a.mcap", sequences.frames(90, "jpeg", hidden=5))


def frames_of(path: Path) -> list[CapturedFrame]:
    return list(open_source(CameraConfig(f"mcap:{path}")).frames(0))


def edit(source: Path, out: Path, name: str, *options: object) -> int:
    return main(["edit", str(source), "--edit", name, "--out", str(out), *(str(option) for option in options)])


def payloads(path: Path) -> list[tuple[object, ...]]:
    return [(r.key, r.log_time_ns, str(r.message)) for r in read_recording(path)]


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_sequence_is_one_like_any_other(
    name: str, sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / f"{name}.mcap"
    assert edit(sequence, out, name) == 0
    record, frames, before = read_edit(out), frames_of(out), frames_of(sequence)
    assert capsys.readouterr().out.startswith(f"{out}: {name}, {len(frames)} frames")
    assert (record.edit, record.source, record.recipe.seed) == (name, "a.mcap", 0)
    assert [frame.frame_id for frame in record.frames] == [frame.frame_id for frame in frames]
    painted = 0
    for frame, told in zip(frames, record.frames, strict=True):
        source = before[told.source_frame_id - sequences.FIRST_ID]
        assert frame.encoding == "jpeg"
        assert frame.truth is not None
        assert source.truth is not None
        np.testing.assert_array_equal(frame.truth.cam_from_object, source.truth.cam_from_object)  # type: ignore[arg-type]
        painted += not np.array_equal(frame.image, source.image)
        assert told.edited or np.array_equal(frame.image, source.image)
    assert (painted > 0) == (name in ("occluder", "gone", "black", "blur", "exposure", "flicker"))
    assert info(out).lossless
    assert main(["info", str(out)]) == 0
    assert f"edited: edit: {name}" in capsys.readouterr().out
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_visibility_is_by_frame_and_zero_where_nothing_is_to_be_seen(sequence: Path, tmp_path: Path) -> None:
    edit(sequence, tmp_path / "none.mcap", "none")
    assert read_visibility(tmp_path / "none.mcap") == {i: float(i != 5) for i in range(90)}
    edit(sequence, tmp_path / "black.mcap", "black")
    hidden = {i for i, share in read_visibility(tmp_path / "black.mcap").items() if share == 0} - {5}
    assert len(hidden) == 5
    for frame in frames_of(tmp_path / "black.mcap"):
        assert (cv2.imdecode(frame.image, cv2.IMREAD_COLOR).max() == 0) == (frame.frame_id in hidden)
    edit(sequence, tmp_path / "occluder.mcap", "occluder")
    shares = read_visibility(tmp_path / "occluder.mcap")
    assert min(share for i, share in shares.items() if i != 5) == pytest.approx(0.2, abs=0.02)
    with pytest.raises(RecordingError, match=r"a\.mcap: has no attachment 'edit\.json'"):
        read_visibility(sequence)


@pytest.mark.parametrize("name", ["occluder", "gone", "stamps"])
def test_the_same_seed_writes_the_same_messages(name: str, sequence: Path, tmp_path: Path) -> None:
    for out, seed in (("a", 3), ("b", 3), ("c", 4)):
        edit(sequence, tmp_path / out, name, "--seed", seed)
    assert payloads(tmp_path / "a") == payloads(tmp_path / "b")
    assert read_edit(tmp_path / "a") == read_edit(tmp_path / "b")
    assert payloads(tmp_path / "a") != payloads(tmp_path / "c")


def test_a_part_is_cut_out_thinned_and_shrunk(sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.mcap"
    choice = ("--start", 1, "--seconds", 3, "--every", 4, "--frames", 6, "--size", 32, "--quality", 80)
    assert edit(sequence, out, "none", *choice) == 0
    frames, record = frames_of(out), read_edit(out)
    assert [frame.source_frame_id for frame in record.frames] == [17, 21, 25, 29, 33, 37]
    assert set(np.diff([frame.at_ns for frame in frames])) == {400 * sequences.MS}  # type: ignore[arg-type]
    assert {frame.camera for frame in frames} == {sequences.CAMERA.shrunk(32)}
    assert cv2.imdecode(frames[0].image, cv2.IMREAD_COLOR).shape == (24, 32, 3)
    assert (record.recipe.every, record.recipe.quality) == (4, 80)
    edit(sequence, tmp_path / "end.mcap", "none", "--seconds", 0.5)
    assert [frame.source_frame_id for frame in read_edit(tmp_path / "end.mcap").frames] == [7, 8, 9, 10, 11]


@pytest.mark.parametrize("encoding", ["png", "rgb8"])
def test_untouched_images_stay_as_they_are_and_edited_ones_become_jpeg(encoding: Encoding, tmp_path: Path) -> None:
    source = sequences.write(tmp_path / "a.mcap", sequences.frames(40, encoding))
    assert edit(source, tmp_path / "b.mcap", "blur") == 0
    record = read_edit(tmp_path / "b.mcap")
    for frame, told, before in zip(frames_of(tmp_path / "b.mcap"), record.frames, frames_of(source), strict=True):
        assert frame.encoding == ("jpeg" if told.edited else encoding)
        assert told.edited or np.array_equal(frame.image, before.image)


def test_the_demo_can_be_edited(tmp_path: Path) -> None:
    demo = demo_file("sequence.mcap")
    assert edit(demo, tmp_path / "a.mcap", "swapped", "--frames", 40) == 0
    before = frames_of(demo)[:40]
    for frame in frames_of(tmp_path / "a.mcap"):
        assert frame.image.tobytes() == before[frame.frame_id].image.tobytes()
        assert frame.at_ns == before[frame.frame_id].at_ns


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing.mcap", "--edit", "none"], "nothing.mcap: cannot be read: No such file"),
        (["text.mcap", "--edit", "none"], "text.mcap: is no recording"),
        (["silent.mcap", "--edit", "none"], "silent.mcap: no camera frames in this recording"),
        (["a.mcap", "--edit", "blurr"], "edit 'blurr': did you mean blur?"),
        (["a.mcap", "--edit", "melt"], "edit 'melt': expected one of none, occluder"),
        (["a.mcap"], "--edit"),
        (["a.mcap", "--edit", "none", "--start", "60"], "a.mcap: no frames in the part chosen"),
        (["a.mcap", "--edit", "black", "--seconds", "2"], "the part chosen lasts 1.90 s, but this edit needs 3 s"),
        (["a.mcap", "--edit", "none", "--every", "0"], "--every is 0, but must be more than 0"),
        (["a.mcap", "--edit", "none", "--seconds", "nan"], "--seconds is nan"),
        (["a.mcap", "--edit", "none", "--start", "-1"], "--seed and --start must be 0 or more"),
        (["a.mcap", "--edit", "none", "--quality", "101"], "--quality is 101, but must lie between 1 and 100"),
        (["a.mcap", "--edit", "none", "--out", "a.mcap"], "a.mcap: is there already"),
        (["a.mcap", "--edit", "none", "--out", "folder"], "folder: is a folder"),
        (["a.mcap", "--edit", "none", "--out", "text.mcap/b.mcap"], "its folder cannot be made"),
        (["a.mcap", "--edit", "none", "--out", "begun.mcap"], "an unfinished recording is in the way"),
        (["edited.mcap", "--edit", "none"], "edited.mcap: is an edited sequence"),
        (["broken.mcap", "--edit", "flicker"], "the jpeg image of frame 7 cannot be read"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing_behind(
    arguments: list[str], said: str, sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.mcap").write_bytes(sequence.read_bytes())
    (tmp_path / "text.mcap").write_text("no recording at all")
    (tmp_path / "begun.mcap.partial").write_bytes(b"begun")
    (tmp_path / "folder").mkdir()
    RecordingWriter("silent.mcap").close()
    sequences.write(tmp_path / "broken.mcap", [_broken(frame) for frame in sequences.frames(2, "jpeg")])
    edit(sequence, tmp_path / "edited.mcap", "none", "--frames", 2)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert main(["edit", *arguments, *([] if "--out" in arguments else ["--out", "b.mcap"])]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("fieldpose: ")
    assert said in lines[0]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def _broken(frame: CapturedFrame) -> CapturedFrame:
    return replace(frame, image=np.zeros(10, np.uint8))


def test_a_full_disk_is_told_and_nothing_is_left(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RecordingWriter, "write", full)
    monkeypatch.setattr(RecordingWriter, "discard", full)
    assert edit(sequence, tmp_path / "a.mcap", "none") == 2
    assert "a.mcap: cannot be written: No space left on device" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_help_lists_every_edit(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["edit", "--help"])
    said = capsys.readouterr().out
    assert all(f"{name}:" in said for name in EDITS)
