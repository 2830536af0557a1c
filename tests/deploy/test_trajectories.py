"""Poses for other programs: TUM's trajectories and COLMAP's models, of runs and of recordings."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from fieldpose.bus.messages import CameraInfo, Reason, State, TrackingState
from fieldpose.bus.ports import first_header
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import CAMERA_INFO, STATE, Address
from fieldpose.deploy.cli import main
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.deploy.reporting.trajectories import PoseFiles, Trajectory, in_words, to_tum
from fieldpose.errors import OutputError
from fieldpose.stages.geometry import Camera, exp_se3, inverse
from fieldpose.stages.structure.colmap_files import read_model

ADDRESS = Address("test", "mug", "cam")
BENT = Camera(640, 480, 520.25, 523.5, 325.0, 236.0, (-0.2, 0.08, 0.001, -0.0008, 0.01))
PLAIN = Camera(640, 480, 520.25, 520.25, 319.5, 239.5)
FIRST_NS = 1_700_000_000_123_456_789


def pose(i: int) -> np.ndarray:
    return exp_se3(np.array([0.1 * i, -0.2, 2.0 + i, 0.3 * i, -1.7, 0.2]))


def frame(i: int, state: str = "tracking", **values: object) -> FrameResult:
    known = FrameResult(i, FIRST_NS + i * 33_333_333, "finished", state=state, score=0.9, cam_from_object=pose(i))
    return replace(known, **({"camera": BENT} | values))  # type: ignore[arg-type]


@pytest.fixture
def trajectory() -> Trajectory:
    lost = frame(3, "lost", cam_from_object=None)
    return Trajectory(ADDRESS, "metres", [frame(0), frame(1, "limited"), frame(2), lost, frame(4, camera=PLAIN)])


def test_a_trajectory_can_be_read_back(trajectory: Trajectory, tmp_path: Path) -> None:
    path = tmp_path / "run.tum"
    path.write_bytes(to_tum(trajectory))
    rows = np.loadtxt(path)
    assert rows.shape == (3, 8)
    for row, i in zip(rows, (0, 2, 4), strict=True):
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
        np.testing.assert_allclose(found, inverse(pose(i)), atol=1e-12)
        assert row[7] >= 0
    lines = path.read_text().splitlines()
    assert "cam in the frame of mug" in lines[0]
    assert "lengths in metres" in lines[1]
    assert [line.split()[0] for line in lines[2:]] == [
        "1700000000.123456789",
        "1700000000.190123455",
        "1700000000.256790121",
    ]


def test_a_model_is_what_colmap_reads(trajectory: Trajectory, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    files = PoseFiles(colmap=folder)
    files.check()
    (line,) = files.write(trajectory)
    assert line == f"{folder}: 3 poses of cam in the frame of mug; 2 frames left out (1 limited, 1 without a pose)"
    assert {path.name for path in folder.iterdir()} == {"cameras.txt", "images.txt", "points3D.txt"}
    scene = pycolmap.Reconstruction(folder)
    assert (scene.num_images(), scene.num_cameras(), scene.num_points3D()) == (3, 2, 0)
    image = next(image for image in scene.images.values() if image.name == "00000.jpg")
    np.testing.assert_allclose(image.cam_from_world().matrix(), pose(0)[:3], atol=1e-12)
    # COLMAP's first pixel has its centre at 0.5.
    point = np.array([0.1, -0.2, 2.5])
    seen = scene.cameras[image.camera_id].img_from_cam(point)
    np.testing.assert_allclose(np.ravel(seen) - 0.5, BENT.project(point[None])[0], atol=1e-9)
    read = read_model(folder)
    assert [image.name for image in read] == ["00000.jpg", "00002.jpg", "00004.jpg"]
    assert [image.camera for image in read] == [BENT, BENT, PLAIN]
    with pytest.raises(OutputError, match="is there already and not empty"):
        files.check()
    (tmp_path / "empty").mkdir()
    PoseFiles(colmap=tmp_path / "empty").check()
    list(PoseFiles(colmap=tmp_path / "empty").write(trajectory))
    assert (tmp_path / "empty" / "images.txt").exists()


def test_frames_of_the_same_number_have_names_of_their_own(tmp_path: Path) -> None:
    again = Trajectory(ADDRESS, "metres", [frame(0), replace(frame(0), capture_ns=5), frame(1, camera=None)])
    assert again.names == [f"00000-{FIRST_NS}.jpg", "00000-5.jpg", "00001.jpg"]
    (line,) = PoseFiles(colmap=tmp_path / "model").write(again)
    assert line.endswith("; 1 of them without a camera")
    assert pycolmap.Reconstruction(tmp_path / "model").num_images() == 2


def test_nothing_sure_is_said(tmp_path: Path) -> None:
    (line,) = PoseFiles(tmp_path / "run.tum").write(Trajectory(ADDRESS, in_words(None), [frame(0, "limited")]))
    assert line.endswith("0 poses of cam in the frame of mug; 1 frames left out (1 limited)")
    assert all(text.startswith("#") for text in (tmp_path / "run.tum").read_text().splitlines())


def record(path: Path, *addresses: Address) -> Path:
    """Five frames of each pipeline, of which the second is not sure and the fourth has no pose of its own."""
    writer = RecordingWriter(path)
    for address in addresses:
        for i in range(5):
            header = first_header(i, FIRST_NS + i * 33_333_333)
            state = State(
                header=header, state=TrackingState.LIMITED if i == 1 else TrackingState.TRACKING,
                score=0.0 if i == 3 else 0.9, cam_from_object=pose(i), covariance=np.eye(6) * 1e-6,
                reason=Reason.TOO_FEW_MATCHES if i == 3 else None, in_flight=0, admitted=i, finished=i,
                dropped_at_the_door=0, lost=0,
            )  # fmt: skip
            writer.write(address.key(CAMERA_INFO), CAMERA_INFO, CameraInfo(header=header, camera=BENT), 1000 + i)
            writer.write(address.key(STATE), STATE, state, 2000 + i)
    writer.close()
    return path


def test_poses_of_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = record(tmp_path / "run.mcap", ADDRESS)
    tum, colmap, rows = tmp_path / "run.tum", tmp_path / "model", tmp_path / "run.csv"
    assert main(["poses", str(recording), "--tum", str(tum), "--colmap", str(colmap), "--csv", str(rows)]) == 0
    said = capsys.readouterr().out
    counted = "3 poses of cam in the frame of mug; 2 frames left out (1 limited, 1 without a pose)"
    assert said.splitlines() == [f"{tum}: {counted}", f"{colmap}: {counted}", f"{rows}: 5 frames"]
    stamps = [line.split()[0] for line in tum.read_text().splitlines() if not line.startswith("#")]
    assert [int(stamp.replace(".", "")) for stamp in stamps] == [FIRST_NS + i * 33_333_333 for i in (0, 2, 4)]
    for image, i in zip(read_model(colmap), (0, 2, 4), strict=True):
        assert (image.name, image.camera) == (f"{i:05d}.jpg", BENT)
        np.testing.assert_allclose(image.cam_from_world, pose(i), atol=1e-12)
    with rows.open() as file:
        table = list(csv.DictReader(file))
    assert [row["state"] for row in table] == ["tracking", "limited", "tracking", "tracking", "tracking"]
    assert float(table[4]["cam_from_object_23"]) == pytest.approx(pose(4)[2, 3])
    assert table[3]["cam_from_object_00"] == ""


def test_which_pipeline_and_what_to_write_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = record(tmp_path / "run.mcap", ADDRESS, Address("test", "bowl", "cam"))
    out = tmp_path / "out" / "run.tum"
    empty = tmp_path / "empty.mcap"
    RecordingWriter(empty).close()
    for arguments, said in (
        ([recording], "nothing to write; give --tum, --colmap or --csv"),
        ([recording, "--tum", out], "holds the pipelines bowl/cam, mug/cam; choose one with --pipeline"),
        ([recording, "--tum", out, "--pipeline", "mug/left"], "holds the pipelines bowl/cam, mug/cam"),
        ([empty, "--tum", out], "holds no poses, since nothing of the topic state was recorded"),
        ([tmp_path / "none.mcap", "--tum", out], "cannot be read"),
    ):
        assert main(["poses", *map(str, arguments)]) == 2
        assert said in capsys.readouterr().err
        assert not out.parent.exists()
    assert main(["poses", str(recording), "--tum", str(out), "--pipeline", "bowl/cam"]) == 0
    assert "cam in the frame of bowl" in out.read_text()
