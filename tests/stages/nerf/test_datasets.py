import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import posed_images as made

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import camera_centre, inverse, is_rigid, look_at, rotation_error_deg, translation_error
from fieldpose.stages.nerf.datasets import find_name, load_dataset

SQUARE = made.centred(80, 80, 95.0)
WIDE = made.centred(192, 128, 200.0)


def test_blender(tmp_path: Path) -> None:
    poses = made.write_blender(tmp_path, SQUARE)
    train, test = load_dataset(tmp_path), load_dataset(tmp_path, "test")
    assert (train.kind, train.scene, train.background, train.has_alpha) == ("blender", "object", (255, 255, 255), True)
    assert [record.name for record in train.images] == [f"train/r_{i}.png" for i in range(6)]
    made.assert_poses(train, poses[:6])
    made.assert_poses(test, poses[6:])
    made.assert_poses(load_dataset(tmp_path, "all"), poses)
    assert train.images[0].camera == SQUARE
    assert train.load_image(0).shape == (80, 80, 4)
    assert made.worst_dot_px(train) < 0.1
    assert not train.notes


@pytest.mark.parametrize("size", [40, 33])
def test_images_and_cameras_shrink_together(tmp_path: Path, size: int) -> None:
    made.write_blender(tmp_path, WIDE)
    dataset = load_dataset(tmp_path, size=size)
    assert dataset.load_image(0).shape == (round(size * 128 / 192), size, 4)
    assert made.worst_dot_px(dataset) < 0.1
    assert made.worst_dot_px(load_dataset(tmp_path).resized(size)) < 0.1
    assert [image.shape for image in load_dataset(tmp_path).load_images(size)] == [dataset.load_image(0).shape] * 6


def test_size_never_enlarges_and_downscale_divides(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    assert load_dataset(tmp_path, size=500).images[0].camera == SQUARE
    assert load_dataset(tmp_path, downscale=4).images[0].camera.width == 20
    for options in ({"size": 40, "downscale": 2}, {"size": 0}, {"downscale": -1}):
        with pytest.raises(DatasetError, match=r"size or downscale|must be at least 1"):
            load_dataset(tmp_path, **options)


def test_blender_without_test_file_has_a_train_split_only(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    (tmp_path / "transforms_test.json").unlink()
    assert len(load_dataset(tmp_path, "all")) == 6
    with pytest.raises(DatasetError, match="the test split is empty"):
        load_dataset(tmp_path, "test")


def test_scene_with_a_box_and_ground_truth(tmp_path: Path) -> None:
    """The demo scene's way of writing: extensions, intrinsics with (0, 0) at a pixel's centre, depth and masks."""
    made.write_blender(tmp_path, made.CAMERA, channels=3)
    about = {"aabb": [[-2, -2, -1], [2, 3, 1]], "object_aabb": [[-1, -1, -1], [1, 1, 1]], "metres_per_unit": 0.1}
    for split in ("train", "test"):
        made.edit_json(tmp_path / f"transforms_{split}.json", **made.intrinsics(made.CAMERA, 0.0), **about)
    depth = np.arange(64 * 96, dtype=np.uint16).reshape(64, 96)
    made.save(tmp_path / "depth/0.png", depth)
    made.save(tmp_path / "mask/0.png", np.where(depth % 96 < 40, 255, 0).astype(np.uint8))
    truth = {"depth_file_path": "depth/0.png", "depth_scale": 0.001, "mask_file_path": "mask/0.png"}
    made.edit_frame(tmp_path / "transforms_test.json", 0, **truth, file_path="test/r_0.png")
    dataset = load_dataset(tmp_path, "test")
    assert (dataset.scene, dataset.background, dataset.metres_per_unit) == ("bounded", None, 0.1)
    assert dataset.images[0].camera == made.CAMERA
    assert dataset.object_aabb is not None
    np.testing.assert_allclose(dataset.object_aabb, about["object_aabb"])
    np.testing.assert_allclose(dataset.bounds.aabb, about["aabb"])
    np.testing.assert_allclose(dataset.load_depth(0), depth * 0.001, rtol=1e-6)
    assert dataset.load_mask(0).dtype == bool
    assert dataset.load_mask(0).sum() == 40 * 64
    assert made.worst_dot_px(dataset) < 0.1
    half = dataset.resized(48)
    assert half.load_depth(0).shape == half.load_mask(0).shape == (32, 48)
    assert set(np.unique(half.load_depth(0))) <= set(np.unique(dataset.load_depth(0)))
    for load in (dataset.load_depth, dataset.load_mask):
        with pytest.raises(DatasetError, match=r"r_1\.png: the dataset has no"):
            load(1)


def test_depth_may_be_an_array_file(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    depth = np.random.default_rng(0).uniform(1, 5, (80, 80))
    np.save(tmp_path / "depth.npy", depth)
    made.edit_frame(tmp_path / "transforms_test.json", 0, depth_file_path="depth.npy", depth_scale=1)
    np.testing.assert_allclose(load_dataset(tmp_path, "test").load_depth(0), depth, rtol=1e-6)


def test_transparent_images_lie_over_the_background_and_edges_keep_their_colour(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    pixels = np.full((80, 80, 4), (250, 0, 250, 0), np.uint8)
    pixels[:, 41:] = (10, 200, 30, 255)
    made.save(tmp_path / "train/r_0.png", pixels)
    dataset = load_dataset(tmp_path, size=40)
    edge = dataset.load_image(0)[20, 20]
    assert abs(int(edge[3]) - 128) <= 1
    np.testing.assert_allclose(edge[:3], (10, 200, 30), atol=1)
    rgb = dataset.load_rgb(0)
    assert rgb.shape == (40, 40, 3)
    assert (rgb[:, 0] == 255).all()
    np.testing.assert_allclose(rgb[20, 20], (132, 227, 142), atol=2)


def test_an_alpha_channel_that_hides_nothing_is_no_cut_out(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE, channels=3)
    for path in tmp_path.rglob("*.png"):
        Image.open(path).convert("RGBA").save(path)
    dataset = load_dataset(tmp_path)
    assert (dataset.scene, dataset.background) == ("unbounded", None)
    assert dataset.load_image(0).shape == dataset.load_rgb(0).shape == (80, 80, 3)


def test_exif_orientation_is_ignored_as_by_colmap(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.CAMERA)
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(tmp_path / "images/0000.png") as image:
        image.convert("RGB").save(tmp_path / "images/0000.png", exif=exif)
    assert made.worst_dot_px(load_dataset(tmp_path)) < 0.1


def test_transforms(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.DISTORTED)
    train, test = load_dataset(tmp_path, "train"), load_dataset(tmp_path, "test")
    assert (train.kind, train.scene, train.background) == ("transforms", "unbounded", None)
    made.assert_poses(train, poses[0::2])
    made.assert_poses(test, poses[1::2])
    np.testing.assert_allclose(train.images[0].camera.matrix(), made.DISTORTED.matrix())
    assert train.images[0].camera.distortion == made.DISTORTED.distortion
    assert made.worst_dot_px(load_dataset(tmp_path, "all")) < 0.1
    assert made.worst_dot_px(load_dataset(tmp_path, "all", size=48)) < 0.1


def test_holdout(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA, count=10)
    made.assert_poses(load_dataset(tmp_path, "test", holdout="every8"), [poses[0], poses[8]])
    made.assert_poses(load_dataset(tmp_path, "test", holdout="odd"), poses[1::2])
    made.assert_poses(load_dataset(tmp_path, "train", holdout=None), poses)
    with pytest.raises(DatasetError, match="the test split is empty"):
        load_dataset(tmp_path, "test", holdout=None)


def test_transforms_are_sorted_by_file_name(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA)
    file = tmp_path / "transforms.json"
    made.edit_json(file, frames=json.loads(file.read_text())["frames"][::-1])
    made.assert_poses(load_dataset(tmp_path, "all"), poses)


def test_transforms_spellings(tmp_path: Path) -> None:
    """./ and \\ in paths, no extension, three rows of a matrix, COLMAP's names of models."""
    poses = made.write_transforms(tmp_path, made.CAMERA)
    file = tmp_path / "transforms.json"
    made.edit_json(file, camera_model="OPENCV", is_fisheye=False, applied_transform=[[1, 0, 0, 0]])
    made.edit_frame(file, 0, file_path="./images/0000")
    made.edit_frame(file, 1, file_path="images\\0001.png", colmap_im_id=2)
    made.edit_frame(file, 2, transform_matrix=made.opengl(poses[2])[:3])
    dataset = load_dataset(tmp_path, "all")
    made.assert_poses(dataset, poses)
    assert [record.name for record in dataset.images[:2]] == ["images/0000.png", "images/0001.png"]


def test_each_frame_may_have_its_own_intrinsics(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA)
    own = made.centred(60, 90, 130.0)
    made.save(tmp_path / "images/0001.png", made.picture(own, poses[1]))
    made.edit_frame(tmp_path / "transforms.json", 1, **made.intrinsics(own), camera_model="PINHOLE")
    dataset = load_dataset(tmp_path, "all")
    assert [record.camera for record in dataset.images[:2]] == [made.CAMERA, own]
    assert made.worst_dot_px(dataset) < 0.1


def test_a_frames_angle_goes_before_the_files_focal_length(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.CAMERA)
    made.edit_frame(tmp_path / "transforms.json", 0, camera_angle_x=1.0, camera_angle_y=0.6)
    camera = load_dataset(tmp_path).images[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((48 / np.tan(0.5), 32 / np.tan(0.3)))


def test_angles_alone_are_enough(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, WIDE)
    file = tmp_path / "transforms.json"
    frames = json.loads(file.read_text())["frames"]
    made.write_json(file, {"camera_angle_x": 2 * np.arctan(192 / 400), "frames": frames})
    assert load_dataset(tmp_path).images[0].camera.matrix() == pytest.approx(WIDE.matrix())
    assert made.worst_dot_px(load_dataset(tmp_path)) < 0.1


@pytest.mark.parametrize("held_out", ["test_filenames", "val_filenames"])
def test_splits_that_the_file_names(tmp_path: Path, held_out: str) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA)
    names = [f"./images/{i:04d}.png" for i in range(7)]
    made.edit_json(tmp_path / "transforms.json", train_filenames=names[:4], **{held_out: names[4:6]})
    made.assert_poses(load_dataset(tmp_path, "train"), poses[:4])
    made.assert_poses(load_dataset(tmp_path, "test"), poses[4:6])
    made.assert_poses(load_dataset(tmp_path, "all"), poses[:6])


def test_blurred_frames_that_were_deleted_are_left_out_with_a_note(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA)
    for i in range(7):
        made.edit_frame(tmp_path / "transforms.json", i, sharpness=20.0 + i)
    (tmp_path / "images/0002.png").unlink()
    dataset = load_dataset(tmp_path, "test")
    made.assert_poses(dataset, [poses[1], poses[4], poses[6]])
    assert dataset.notes == ("transforms.json: 1 of 7 frames have no image and are left out: images/0002.png",)


def test_llff_as_stored(tmp_path: Path) -> None:
    poses = made.write_llff(tmp_path, WIDE)
    dataset = load_dataset(tmp_path, "all", llff_normalise=False)
    assert (dataset.kind, dataset.scene, dataset.scale) == ("llff", "unbounded", 1.0)
    made.assert_poses(dataset, poses)
    assert dataset.images[0].camera == WIDE
    assert {(record.near, record.far) for record in dataset.images} == {(3.0, 30.0)}
    assert made.worst_dot_px(dataset) < 0.1
    made.assert_poses(load_dataset(tmp_path, "test", llff_normalise=False), [poses[0], poses[8]])


def test_llff_normalised_is_the_same_scene_seen_from_the_average_camera(tmp_path: Path) -> None:
    poses = made.write_llff(tmp_path, WIDE)
    dataset = load_dataset(tmp_path, "all")
    assert dataset.scale == pytest.approx(1 / (0.75 * 3))
    assert dataset.images[0].near == pytest.approx(1 / 0.75)
    assert dataset.images[0].far == pytest.approx(10 / 0.75)
    found = [record.cam_from_object for record in dataset.images]
    np.testing.assert_allclose(np.mean([camera_centre(pose) for pose in found], axis=0), 0, atol=1e-9)
    looking = np.mean([pose[2, :3] for pose in found], axis=0)
    np.testing.assert_allclose(looking / np.linalg.norm(looking), (0, 0, -1), atol=1e-9)
    assert np.mean([pose[1, :3] for pose in found], axis=0)[1] < -0.9
    for i in (1, 4):
        assert rotation_error_deg(found[0], found[i]) == pytest.approx(rotation_error_deg(poses[0], poses[i]), abs=1e-6)
        scaled = translation_error(poses[0], poses[i]) * dataset.scale
        assert translation_error(found[0], found[i]) == pytest.approx(scaled)
    in_cam = poses[0] @ [*made.POINT, 1]
    in_cam[:3] *= dataset.scale
    assert made.worst_dot_px(dataset, (inverse(found[0]) @ in_cam)[:3]) < 0.1


def test_llff_takes_the_folder_that_suits_the_size(tmp_path: Path) -> None:
    made.write_llff(tmp_path, WIDE, factors=(1, 2, 8))

    def folder_and_width(**options: int) -> tuple[str, int]:
        record = load_dataset(tmp_path, **options).images[0]
        return record.path.parent.name, record.camera.width

    assert folder_and_width() == ("images", 192)
    assert folder_and_width(downscale=2) == ("images_2", 96)
    assert folder_and_width(size=24) == ("images_8", 24)
    assert folder_and_width(size=90) == ("images_2", 90)
    assert folder_and_width(size=500) == ("images", 192)
    dataset = load_dataset(tmp_path, size=90, llff_normalise=False)
    assert made.worst_dot_px(dataset) < 0.1


def test_bounds_of_objects_and_scenes(tmp_path: Path) -> None:
    made.write_blender(tmp_path / "object", SQUARE)
    bounds = load_dataset(tmp_path / "object").bounds
    np.testing.assert_allclose(bounds.centre, 0, atol=1e-6)
    seen = 4 * 40 / 95
    np.testing.assert_allclose(bounds.aabb, [[-1.05 * seen] * 3, [1.05 * seen] * 3], rtol=1e-6)
    assert 0 < bounds.near < 4 - seen < bounds.far

    made.write_transforms(tmp_path / "around", made.CAMERA)
    bounds = load_dataset(tmp_path / "around").bounds
    np.testing.assert_allclose(bounds.centre, 0, atol=1e-6)
    assert 4 < bounds.radius < 4.5
    assert bounds.far is None
    assert 0 < bounds.near < 0.5

    made.write_llff(tmp_path / "ahead", WIDE)
    dataset = load_dataset(tmp_path / "ahead")
    ahead = -dataset.bounds.centre[2]
    assert 3 * dataset.scale < ahead < 30 * dataset.scale
    assert max(np.linalg.norm(camera_centre(r.cam_from_object) - dataset.bounds.centre) for r in dataset.images) < (
        dataset.bounds.radius
    )
    assert dataset.bounds.near == pytest.approx(0.9 / 0.75)
    assert dataset.bounds.far == pytest.approx(10 / 0.75)


@pytest.mark.parametrize("fan", [0.0, 0.3])
def test_bounds_of_cameras_that_face_one_way_or_apart_lie_ahead_of_them(tmp_path: Path, fan: float) -> None:
    made.write_transforms(tmp_path, made.CAMERA, count=3)
    for i, x in enumerate((-1.0, 0.0, 1.0)):
        pose = look_at((x, 0, 0), (x + fan * x, 1, 0), (0, 0, 1))
        made.edit_frame(tmp_path / "transforms.json", i, transform_matrix=made.opengl(pose))
    np.testing.assert_allclose(load_dataset(tmp_path, holdout=None).bounds.centre, (0, 1, 0), atol=0.03)


def test_bounds_of_cameras_that_look_outwards_lie_around_them(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA, count=8)
    for i, pose in enumerate(poses):
        eye = camera_centre(pose) + np.array((1, 2, 0))
        outwards = made.opengl(look_at(eye, eye + camera_centre(pose) * (1, 1, 0), (0, 0, 1)))
        made.edit_frame(tmp_path / "transforms.json", i, transform_matrix=outwards)
    bounds = load_dataset(tmp_path, holdout=None).bounds
    np.testing.assert_allclose(bounds.centre, (1, 2, 2.4), atol=1e-6)
    assert bounds.radius == pytest.approx(1.05 * 4 * 0.8)


def test_rounded_poses_become_rigid(tmp_path: Path) -> None:
    poses = made.write_transforms(tmp_path, made.CAMERA)
    rounded = np.round(made.opengl(poses[0]), 4)
    made.edit_frame(tmp_path / "transforms.json", 0, transform_matrix=rounded.tolist())
    found = load_dataset(tmp_path).images[0].cam_from_object
    assert is_rigid(found, 1e-12)
    np.testing.assert_allclose(found, poses[0], atol=5e-4)


def test_bounds_do_not_depend_on_the_split(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    train, test = load_dataset(tmp_path, "train").bounds, load_dataset(tmp_path, "test").bounds
    np.testing.assert_array_equal(train.aabb, test.aabb)
    elsewhere = made.opengl(look_at((9, 9, 9), (5, 0, 0), (0, 0, 1)))
    made.edit_frame(tmp_path / "transforms_test.json", 0, transform_matrix=elsewhere)
    np.testing.assert_array_equal(load_dataset(tmp_path, "all").bounds.aabb, train.aabb)


def test_content_hash_knows_the_poses_and_the_pixels(tmp_path: Path) -> None:
    poses = made.write_blender(tmp_path, SQUARE)
    first = load_dataset(tmp_path).content_hash()
    assert first == load_dataset(str(tmp_path)).content_hash()
    assert first != load_dataset(tmp_path, "all").content_hash()
    made.edit_frame(tmp_path / "transforms_train.json", 2, transform_matrix=made.opengl(poses[7]))
    second = load_dataset(tmp_path).content_hash()
    made.save(tmp_path / "train/r_3.png", made.picture(SQUARE, poses[0], 4))
    assert len({first, second, load_dataset(tmp_path).content_hash()}) == 3


def test_images_load_alike_in_threads(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.CAMERA, count=9)
    dataset = load_dataset(tmp_path, "all")
    for i, image in enumerate(dataset.load_images(workers=4)):
        np.testing.assert_array_equal(image, dataset.load_image(i))


def test_images_are_found_by_their_names(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    dataset = load_dataset(tmp_path, "all")
    assert dataset.index("train/r_2.png") == dataset.index("train/r_2") == 2
    assert dataset.index("test/r_1") == 7
    assert load_dataset(tmp_path).index("r_2") == load_dataset(tmp_path).index("r_2.png") == 2
    with pytest.raises(DatasetError, match=r"2 images fit: train/r_2\.png, test/r_2\.png"):
        dataset.index("r_2")
    with pytest.raises(DatasetError, match=r"'r_99'; names are like 'train/r_0\.png'"):
        find_name([record.name for record in dataset.images], "r_99")
