"""Model and render the desk lamp: a thin, plainly painted object without a background, wholly made by this script.

Needs Blender as a Python module, as recordings/demo/make_scene.py does, whose tools it uses:

    python recordings/lamp/make_scene.py --out recordings/lamp --part train
    python recordings/lamp/make_scene.py --out recordings/lamp --part test
    python recordings/lamp/make_scene.py --out recordings/lamp --part surface
    python recordings/lamp/make_scene.py --out recordings/lamp --part picture
    python recordings/lamp/make_scene.py --out /tmp/preview --part preview

One scene unit is 0.2 m. The origin is in the middle of the object, z is up.
Views that are there already are kept: delete images/ after a change.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "demo"))
sys.path.insert(0, str(Path(__file__).parent))

import lamp
from scene import bake, cameras, render
from shapes import Part

SEED = 11
METRES_PER_UNIT = 0.2
SIZE = (400, 400, 0.69)  # width, height, horizontal angle of view
ELEVATIONS = np.radians((5.0, 75.0))
DISTANCES = (3.9, 4.1)
AIM_ERROR = 0.02
BOX_MARGIN = 0.03
SURFACE_POINTS = 4096
BACKDROP = 0.86
COUNTS = {"train": 100, "test": 25}


def build() -> Part:
    """The lamp, one mesh."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    parts = lamp.build()
    bpy.context.view_layer.update()
    whole = bake.joined(parts, "lamp")
    whole.data.transform(Matrix.Translation(-Vector(lamp.MIDDLE)))
    return whole


def lit(samples: int, threads: int) -> bpy.types.Scene:
    """The scene's settings: lamps and sky that stay where they are, nothing behind the object."""
    scene = render.prepare()
    render.light(scene)
    for thing in scene.objects:
        if thing.type == "LIGHT":
            thing.visible_camera = False
    scene.cycles.samples, scene.cycles.use_denoising = samples, True
    scene.cycles.use_adaptive_sampling, scene.cycles.adaptive_threshold = True, 0.003
    scene.cycles.adaptive_min_samples = 16
    scene.cycles.denoiser, scene.cycles.denoising_prefilter = "OPENIMAGEDENOISE", "FAST"
    scene.render.film_transparent = scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    return scene


def views(count: int, seed: int) -> list[np.ndarray]:
    """Cameras spread evenly (a Kronecker sequence) over all azimuths and the heights between ELEVATIONS."""
    rng = np.random.default_rng(seed)
    steps = (np.arange(1, count + 1)[:, None] * np.array((0.7548776662, 0.5698402910)) + rng.uniform(0, 1, 2)) % 1.0
    low, high = np.sin(ELEVATIONS)
    poses = []
    for u, v in steps:
        elevation = float(np.degrees(np.arcsin(low + v * (high - low))))
        eye = cameras.spherical(360 * u, elevation, rng.uniform(*DISTANCES))
        poses.append(cameras.looking(eye, rng.uniform(-AIM_ERROR, AIM_ERROR, 3)))
    return poses


def shot(scene: bpy.types.Scene, pose: np.ndarray, path: Path, seed: int) -> np.ndarray:
    """Render (h, w, 4) uint8, straight alpha, by way of a draft beside `path`."""
    draft = path.with_name(path.stem + ".draft.png")
    render.picture(scene, pose, draft, seed)
    pixels = np.array(Image.open(draft))
    draft.unlink()
    pixels[pixels[..., 3] == 0] = 0
    return pixels


def save(pixels: np.ndarray, path: Path, **options: object) -> None:
    draft = path.with_name(path.stem + ".draft" + path.suffix)
    Image.fromarray(pixels).save(draft, optimize=True, **options)
    draft.rename(path)


def stills(out: Path, split: str, scene: bpy.types.Scene, box: list[list[float]]) -> None:
    """Render a split; an interrupted run goes on where it ended."""
    render.camera(scene, *SIZE)
    folder = out / "images" / split
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i, pose in enumerate(views(COUNTS[split], {"train": 1, "test": 2}[split])):
        path = folder / f"{i:03d}.png"
        if not path.exists():
            save(shot(scene, pose, path, seed=i), path)
        frames.append({"file_path": str(path.relative_to(out)), "transform_matrix": pose.tolist()})
        print(f"{split} {i + 1}/{COUNTS[split]}", flush=True)
    about = {**cameras.intrinsics(*SIZE), "metres_per_unit": METRES_PER_UNIT, "aabb": box, "frames": frames}
    path = out / f"transforms_{split}.json"
    path.with_suffix(".tmp").write_text(json.dumps(about, indent=1) + "\n")
    path.with_suffix(".tmp").rename(path)


def surface(thing: Part, count: int) -> np.ndarray:
    """(count, 3) float32 points of the object, spread evenly over its area."""
    rng = np.random.default_rng(SEED)
    mesh = thing.data
    mesh.calc_loop_triangles()
    corners = np.array([[mesh.vertices[v].co for v in t.vertices] for t in mesh.loop_triangles])
    areas = np.array([t.area for t in mesh.loop_triangles])
    chosen = corners[rng.choice(len(areas), count, p=areas / areas.sum())]
    weights = rng.dirichlet((1, 1, 1), count)
    return np.einsum("nk,nkd->nd", weights, chosen).astype(np.float32)


def write_surface(path: Path, points: np.ndarray) -> None:
    draft = path.with_suffix(".tmp")
    with draft.open("wb") as file:
        np.save(file, points)
    draft.rename(path)


def picture(out: Path, scene: bpy.types.Scene) -> None:
    """The object as a reader of the documentation sees it, before a light grey."""
    render.camera(scene, 800, 600, 0.80)
    pose = cameras.looking(cameras.spherical(-28, 17, 3.9), np.array((0.0, 0.0, -0.02)))
    pixels = shot(scene, pose, out / "picture.png", seed=0).astype(float)
    alpha = pixels[..., 3:] / 255
    over = pixels[..., :3] * alpha + 255 * BACKDROP * (1 - alpha)
    save(np.rint(over).astype(np.uint8), out / "picture.jpg", quality=90, progressive=True)


def preview(out: Path, scene: bpy.types.Scene) -> None:
    out.mkdir(parents=True, exist_ok=True)
    render.camera(scene, *SIZE)
    for i, (azimuth, elevation) in enumerate(((-28, 17), (60, 8), (150, 30), (250, 55))):
        pose = cameras.looking(cameras.spherical(azimuth, elevation, 4.0), np.zeros(3))
        save(shot(scene, pose, out / f"preview_{i}.png", seed=i), out / f"preview_{i}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=("train", "test", "surface", "picture", "preview"), default="preview")
    parser.add_argument("--samples", type=int, default=80, help="rays per pixel; 16 for a quick look")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    thing = build()
    scene = lit(options.samples, options.threads)
    if options.part in COUNTS:
        low, high = np.array(render.bounds([thing]))
        stills(options.out, options.part, scene, np.round([low - BOX_MARGIN, high + BOX_MARGIN], 4).tolist())
    elif options.part == "surface":
        write_surface(options.out / "surface.npy", surface(thing, SURFACE_POINTS))
    else:
        {"picture": picture, "preview": preview}[options.part](options.out, scene)


if __name__ == "__main__":
    main()
