"""Model and render the demo scene: a tin robot among desk clutter, wholly made by this script.

Needs Blender as a Python module, for development only (never at run time):

    pip install "bpy==4.5.*" "numpy<2" pillow "opencv-python-headless<4.12"
    python recordings/demo/make_scene.py --out recordings/demo --part train
    python recordings/demo/make_scene.py --out recordings/demo --part test
    python recordings/demo/make_scene.py --out /tmp/sequence --part sequence     # then make_recording.py
    python recordings/demo/make_scene.py --out recordings/demo --part picture
    python recordings/demo/make_scene.py --out /tmp/preview --part preview

One scene unit is 0.1 m. The robot stands at the origin, z is up, and its front looks along -y.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))

from scene import bake, cameras, clutter, painting, render, robot, room
from scene.primitives import ball, paint
from scene.surfaces import stripes

SEED = 7
DESK_Z = -0.7
METRES_PER_UNIT = 0.1
DEPTH_SCALE = 1 / 4000
OCCLUDER_FRAMES = (178, 222)
LIGHT_MAPS = (768, 1024, 1024, 512)  # pixels: robot, clutter, room, occluder


def build() -> list[bpy.types.Object]:
    """The robot (object index 1), the clutter, the room and the occluder, one mesh each, not yet lit."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(SEED)
    scene, groups, seen = bpy.context.scene, [], set()
    for name, make in (("robot", robot.build), ("clutter", clutter.build), ("room", room.build)):
        make(rng)
        groups.append((name, [t for t in scene.objects if t.name not in seen]))
        seen |= {t.name for t in scene.objects}
    for thing in scene.objects:
        thing.location.z += DESK_Z
    bpy.context.view_layer.update()
    wholes = [bake.joined(things, name) for name, things in groups]
    near = 1e-3
    low = (-room.SIDE_X - near, room.FRONT_Y - 0.1, DESK_Z - near)
    bake.trimmed(wholes[2], low, (room.SIDE_X + near, room.BACK_Y + near, 9.0))
    wholes[0].pass_index = 1
    return [*wholes, occluder()]


def lit(path: Path, quality: float) -> bpy.types.Scene:
    """The finished scene, from `path` where it has been baked before."""
    if path.exists():
        bpy.ops.wm.open_mainfile(filepath=str(path))
        return bpy.context.scene
    things = build()
    scene = render.prepare()
    lamps = render.light(scene)
    things[3].location = (0.0, -1.5, 0.6)
    for thing in things:
        thing.visible_diffuse = thing.visible_shadow = thing is not things[3]
    for thing, size in zip(things, LIGHT_MAPS, strict=True):
        bake.unwrap(thing)
        bake.bake(thing, int(size * quality), max(int(32 * quality), 4))
        print(f"baked {thing.name}", flush=True)
    for material in bpy.data.materials:
        bake.luminous(material, lamps)
    render.only_look(scene)
    things[3].hide_render = True
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True)
    return scene


def describe() -> dict[str, object]:
    things = bpy.data.objects
    return {
        "metres_per_unit": METRES_PER_UNIT,
        "aabb": render.bounds([things["robot"], things["clutter"], things["room"]]),
        "object_aabb": render.bounds([things["robot"]]),
    }


def write_json(path: Path, content: dict[str, object]) -> None:
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(content, indent=1) + "\n")
    draft.rename(path)


def stills(out: Path, split: str, count: int, scene: bpy.types.Scene, about: dict[str, object]) -> None:
    size = (cameras.STILL_WIDTH, cameras.STILL_HEIGHT, cameras.STILL_ANGLE)
    render.camera(scene, *size)
    folder = out / "images" / split
    folder.mkdir(parents=True, exist_ok=True)
    poses = cameras.stills(count, {"train": 1, "test": 2}[split])
    frames: list[dict[str, object]] = []
    for i, pose in enumerate(poses):
        path = folder / f"{i:03d}.jpg"
        render.picture(scene, pose, path, seed=i)
        frames.append({"file_path": str(path.relative_to(out)), "transform_matrix": pose.tolist()})
        print(f"{split} {i + 1}/{count}", flush=True)
    if split == "test":
        truths(out, poses, frames, scene)
    write_json(out / f"transforms_{split}.json", {**cameras.intrinsics(*size), **about, "frames": frames})


def truths(out: Path, poses: list[np.ndarray], frames: list[dict[str, object]], scene: bpy.types.Scene) -> None:
    """Depth (16-bit PNG, DEPTH_SCALE units a step) and mask of the robot (8-bit PNG) of each test view."""
    for name in ("depth", "mask"):
        (out / name).mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        render.measure_only(scene, Path(scratch))
        for i, (pose, frame) in enumerate(zip(poses, frames, strict=True)):
            depth, index = render.depth_and_index(scene, pose, Path(scratch))
            depth_path, mask_path = f"depth/{i:03d}.png", f"mask/{i:03d}.png"
            Image.fromarray(np.round(depth / DEPTH_SCALE).astype(np.uint16)).save(out / depth_path, optimize=True)
            Image.fromarray((index > 0.5).astype(np.uint8) * 255).save(out / mask_path, optimize=True)
            frame |= {"depth_file_path": depth_path, "depth_scale": DEPTH_SCALE, "mask_file_path": mask_path}


def occluder() -> bpy.types.Object:
    """A big striped ball that crosses between camera and robot; outside its frames it is not rendered."""
    rng = np.random.default_rng(SEED)
    tones = (painting.PLUM, painting.CREAM, painting.LEAF, painting.CREAM)
    return ball("occluder", 0.42, (0, 0, 0), paint(stripes(900, 450, tones, 12, rng, 0.4), 0.5))


def place_occluder(thing: bpy.types.Object, frame: int, world_from_cam: np.ndarray) -> None:
    first, last = OCCLUDER_FRAMES
    thing.hide_render = not first <= frame <= last
    across = -1.5 + 3.0 * (frame - first) / (last - first)
    height = 0.12 * np.cos(across * 1.5) - 0.05
    thing.location = (world_from_cam @ (across, height, -1.55, 1.0))[:3]
    thing.rotation_euler = (0.5, across * 2.0, 0.3)


def video(out: Path, scene: bpy.types.Scene, about: dict[str, object], every: int = 1) -> None:
    size = (cameras.VIDEO_WIDTH, cameras.VIDEO_HEIGHT, cameras.VIDEO_ANGLE)
    render.camera(scene, *size)
    out.mkdir(parents=True, exist_ok=True)
    poses, thing = cameras.sequence(SEED), bpy.data.objects["occluder"]
    middle = poses[sum(OCCLUDER_FRAMES) // 2]
    frames = []
    for i, pose in list(enumerate(poses))[::every]:
        place_occluder(thing, i, middle)
        path = out / f"{i:04d}.png"
        if not path.exists():
            render.picture(scene, pose, path, seed=1000 + i)
        frames.append({"file_path": path.name, "transform_matrix": pose.tolist()})
        print(f"sequence {i + 1}/{len(poses)}", flush=True)
    about = {**cameras.intrinsics(*size), **about, "rate_hz": cameras.RATE_HZ}
    write_json(out / "poses.json", {**about, "frames": frames})


def preview(out: Path, scene: bpy.types.Scene) -> None:
    out.mkdir(parents=True, exist_ok=True)
    render.camera(scene, cameras.STILL_WIDTH, cameras.STILL_HEIGHT, cameras.STILL_ANGLE)
    for i, (azimuth, elevation) in enumerate(((-20, 22), (60, 15), (-70, 35), (25, 55))):
        eye = cameras.spherical(azimuth, elevation, 2.8)
        render.picture(scene, cameras.looking(eye, np.zeros(3)), out / f"preview_{i}.jpg", seed=i)


def picture(out: Path, scene: bpy.types.Scene) -> None:
    """The scene as a reader of the documentation sees it."""
    render.camera(scene, 1200, 750, 0.92)
    scene.cycles.samples = 32
    pose = cameras.looking(cameras.spherical(-24, 21, 3.3), np.array((0.12, 0.0, 0.06)))
    render.picture(scene, pose, out / "picture.jpg", seed=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=("train", "test", "sequence", "picture", "preview"), default="preview")
    parser.add_argument(
        "--baked",
        type=Path,
        default=Path(tempfile.gettempdir()) / "fieldpose_scene.blend",
        help="where the lit scene is kept between runs; delete it after a change",
    )
    parser.add_argument("--quality", type=float, default=1.0, help="of the light maps; 0.3 for a quick look")
    parser.add_argument("--every", type=int, default=1, help="render only each n-th frame of the sequence")
    options = parser.parse_args()
    scene = lit(options.baked, options.quality)
    about = describe()
    if options.part == "sequence":
        video(options.out, scene, about, options.every)
    elif options.part in ("picture", "preview"):
        {"picture": picture, "preview": preview}[options.part](options.out, scene)
    else:
        stills(options.out, options.part, {"train": 100, "test": 25}[options.part], scene, about)


if __name__ == "__main__":
    main()
