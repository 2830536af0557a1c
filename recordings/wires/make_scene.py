"""Cast rays at a ball on a tripod with a long cable and rods that stand free: thin parts, dark and pale, near and far.

    python recordings/wires/make_scene.py --out out/wires --background none

No Blender is needed: everything is a ball or a rod with round ends, met exactly; 16 rays a pixel are averaged.

background: none (RGBA, straight alpha), white or black (the same over a plain colour, opaque), or room (within papered
walls, a floor and a ceiling, nearer cameras). The opaque ones come with the true depth and the mask of each test view.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numba import njit

HEIGHT, RADIUS = 0.15, 0.3
"""Of the ball."""
ROOM = np.array([[-3.2, -3.2, -1.2], [3.2, 3.2, 3.0]])
BOX = np.array([[-1.4, -1.4, -1.1], [1.4, 1.4, 1.1]])
DEPTH_SCALE = 1 / 8000
RAYS_A_SIDE = 4


@dataclass(frozen=True)
class Views:
    """How many images, of how many pixels a side, and from where: distance in units, angle of view in degrees."""

    train: int = 100
    test: int = 20
    size: int = 400
    distance: float = 4.0
    angle_deg: float = 40.0
    thickness: float = 1.0

    @property
    def focal(self) -> float:
        """In pixels of the image."""
        return self.size / 2 / math.tan(math.radians(self.angle_deg) / 2)


def rods(thickness: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ends (n, 3) and (n, 3), radii (n,) and colours (n, 3) of all rods.

    Wires are 0.008 to 0.012 units thick, times `thickness`; a pixel is 0.0073 units at the middle of a view of 400.
    """
    t = np.linspace(0, 2 * np.pi * 1.6, 120)
    reach = 0.75 + 0.2 * np.sin(1.3 * t)
    cable = np.stack([reach * np.cos(t), reach * np.sin(t), 0.05 + 0.35 * np.sin(0.7 * t)], axis=1)
    parts = [(a, b, 0.006, (0.06, 0.06, 0.07)) for a, b in pairwise(cable)]
    for k in range(3):
        foot = (0.55 * math.cos(2 * math.pi * k / 3), 0.55 * math.sin(2 * math.pi * k / 3), -0.9)
        parts.append((np.array((0, 0, 0.1)), np.array(foot), 0.015, (0.5, 0.35, 0.2)))
    parts.append((np.array((0.9, 0.9, -0.9)), np.array((0.9, 0.9, 0.8)), 0.005, (0.7, 0.1, 0.1)))
    parts.append((np.array((-1.0, 0.2, -0.8)), np.array((-1.0, 0.2, 0.9)), 0.004, (0.1, 0.3, 0.7)))
    parts.append((np.array((0.2, -1.1, 0.9)), np.array((1.0, -0.6, 0.9)), 0.005, (0.93, 0.92, 0.88)))
    a, b, radius, colour = zip(*parts, strict=True)
    return np.array(a), np.array(b), thickness * np.array(radius), np.array(colour)


@njit
def paper(p, q):  # type: ignore[no-untyped-def]
    """A wall's colour in 0..1: rings and stripes of several sizes."""
    a = 0.5 + 0.5 * math.sin(3.1 * p + 1.7 * math.sin(2.3 * q))
    b = 0.5 + 0.5 * math.sin(5.3 * q + 2.1 * math.cos(1.9 * p))
    c = 0.5 + 0.5 * math.sin(11.0 * math.hypot(p - 0.4, q + 0.7))
    return 0.25 + 0.6 * a * c, 0.3 + 0.5 * b, 0.2 + 0.6 * (1 - a) * (0.4 + 0.6 * b)


@njit
def wall(o, x, y, z, low, high):  # type: ignore[no-untyped-def]
    """Distance along the ray (x, y, z), from within a box, to its wall, and the colour there."""
    t, axis, beyond = 1e9, 0, False
    for i, d in enumerate((x, y, z)):
        if abs(d) > 1e-9:
            s = ((high[i] if d > 0 else low[i]) - o[i]) / d
            if s < t:
                t, axis, beyond = s, i, d > 0
    at = (o[0] + t * x, o[1] + t * y, o[2] + t * z)
    return t, paper(at[(axis + 1) % 3] + 3.0 * axis, at[(axis + 2) % 3] - (5.0 if beyond else 0.0))


@njit
def ball(ox, oy, oz, x, y, z, radius):  # type: ignore[no-untyped-def]
    """Distance along the unit ray (x, y, z) from (ox, oy, oz) to a ball around 0; negative where it is not met."""
    b = ox * x + oy * y + oz * z
    h = b * b - (ox * ox + oy * oy + oz * oz) + radius * radius
    return -b - math.sqrt(h) if h > 0 else -1.0


@njit
def rod(o, x, y, z, a, b, j, radius):  # type: ignore[no-untyped-def]
    """Distance along the unit ray to the rod between a[j] and b[j], with round ends; negative where it is not met."""
    bx, by, bz = b[j, 0] - a[j, 0], b[j, 1] - a[j, 1], b[j, 2] - a[j, 2]
    ox, oy, oz = o[0] - a[j, 0], o[1] - a[j, 1], o[2] - a[j, 2]
    mx, my, mz = ox - bx / 2, oy - by / 2, oz - bz / 2
    along = mx * x + my * y + mz * z
    bb = bx * bx + by * by + bz * bz
    reach = radius + math.sqrt(bb) / 2
    if mx * mx + my * my + mz * mz - along * along > reach * reach:
        return -1.0  # beside the ball around it, as nearly all are
    bd, bo = bx * x + by * y + bz * z, bx * ox + by * oy + bz * oz
    do, oo = ox * x + oy * y + oz * z, ox * ox + oy * oy + oz * oz
    k2, k1 = bb - bd * bd, bb * do - bo * bd
    h = k1 * k1 - k2 * (bb * oo - bo * bo - radius * radius * bb)
    if h < 0:
        return -1.0
    t = (-k1 - math.sqrt(h)) / k2
    at = bo + t * bd
    if 0 < at < bb:
        return t
    return ball(ox, oy, oz, x, y, z, radius) if at <= 0 else ball(ox - bx, oy - by, oz - bz, x, y, z, radius)


@njit(nogil=True)
def cast(o, d, a, b, radius, colour, low, high, walls, out, depth):  # type: ignore[no-untyped-def]
    """Fill out (n, 4) with colour and opacity, and depth (n,) with the distance to the object, 0 beside it.

    Opacity is 0.5 where a wall is seen.
    """
    for i in range(d.shape[0]):
        x, y, z = d[i, 0], d[i, 1], d[i, 2]
        nearest, red, green, blue, hit = 1e9, 0.0, 0.0, 0.0, 0.0
        t = ball(o[0], o[1], o[2] - HEIGHT, x, y, z, RADIUS)
        if t > 0:
            u = math.atan2(o[1] + t * y, o[0] + t * x)
            up = (o[2] + t * z - HEIGHT) / RADIUS
            v = math.asin(min(1.0, max(-1.0, up)))
            dark = (math.floor(u * 8 / math.pi) + math.floor(v * 8 / math.pi)) % 2
            light = 0.6 + 0.2 * up
            nearest, hit = t, 1.0
            red, green, blue = (
                (0.8 * light, 0.7 * light, 0.3 * light) if dark else (0.2 * light, 0.4 * light, 0.6 * light)
            )
        for j in range(a.shape[0]):
            t = rod(o, x, y, z, a, b, j, radius[j])
            if 0 < t < nearest:
                nearest, hit, red, green, blue = t, 1.0, colour[j, 0], colour[j, 1], colour[j, 2]
        depth[i] = nearest if hit > 0 else 0.0
        if walls and hit == 0:
            depth[i], (red, green, blue) = wall(o, x, y, z, low, high)
            hit = 0.5
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = red, green, blue, hit


def pose(rng: np.random.Generator, distance: float) -> np.ndarray:
    """A camera (world_from_camera, OpenGL axes) above the ground that looks at the middle."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), math.asin(rng.uniform(0.02, 0.95))
    back = np.array(
        (math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation))
    )
    right = np.cross((0, 0, 1), back)
    right /= np.linalg.norm(right)
    result = np.eye(4)
    result[:3] = np.stack([right, np.cross(back, right), back, distance * back], axis=1)
    return result


def directions(world_from_camera: np.ndarray, size: int, focal: float) -> np.ndarray:
    """Unit rays (size * size, 3) through the middles of an image's pixels."""
    x, y = np.meshgrid(np.arange(size) + 0.5 - size / 2, np.arange(size) + 0.5 - size / 2)
    d = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ world_from_camera[:3, :3].T
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def look(world_from_camera: np.ndarray, views: Views, finer: int, walls: bool) -> tuple[np.ndarray, ...]:
    """Rays, colours and opacity (n, 4), and distances (n,), of a view with `finer` rays along a pixel's sides."""
    d = directions(world_from_camera, views.size * finer, views.focal * finer)
    out, distance = np.empty((len(d), 4)), np.empty(len(d))
    parts, eye = rods(views.thickness), world_from_camera[:3, 3].copy()
    pieces = np.array_split(np.arange(len(d)), 16)
    with ThreadPoolExecutor() as pool:
        list(
            pool.map(
                lambda p: cast(
                    eye, d[p[0] : p[-1] + 1], *parts, *ROOM, walls, out[p[0] : p[-1] + 1], distance[p[0] : p[-1] + 1]
                ),
                pieces,
            )
        )
    return d, out, distance


def picture(world_from_camera: np.ndarray, views: Views, walls: bool) -> np.ndarray:
    """The view (h, w, 4) float: colours times opacity, and opacity; of a room, the object's share of the pixel."""
    _, out, _ = look(world_from_camera, views, RAYS_A_SIDE, walls)
    if walls:
        out[:, 3] = out[:, 3] == 1
    else:
        out[:, :3] *= out[:, 3:]
    return out.reshape(views.size, RAYS_A_SIDE, views.size, RAYS_A_SIDE, 4).mean(axis=(1, 3))


def depth_map(world_from_camera: np.ndarray, views: Views, walls: bool) -> np.ndarray:
    """Depth (h, w) along the optical axis of what is in the middle of each pixel, 0 where nothing is."""
    d, _, distance = look(world_from_camera, views, 1, walls)
    return (distance * (d @ -world_from_camera[:3, 2])).reshape(views.size, views.size)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path}: cannot be written")


def straight(seen: np.ndarray) -> np.ndarray:
    """RGBA with straight alpha, uint8 in OpenCV's order, from colours times opacity."""
    alpha = seen[..., 3:]
    colour = np.divide(seen[..., :3], alpha, out=np.zeros_like(seen[..., :3]), where=alpha > 0)
    return np.rint(255 * np.concatenate([colour[..., ::-1], alpha], axis=-1)).astype(np.uint8)


def make(out: Path, background: str, views: Views = Views(), seed: int = 0) -> None:
    """Write the images and transforms of both splits."""
    room = background == "room"
    rng = np.random.default_rng(seed)
    for split, count in (("train", views.train), ("test", views.test)):
        frames = []
        for k in range(count):
            world_from_camera = pose(rng, views.distance)
            seen = picture(world_from_camera, views, room)
            frame = {"file_path": f"images/{split}/{k:03d}.png", "transform_matrix": world_from_camera.tolist()}
            if background == "none":
                save(out / frame["file_path"], straight(seen))
            else:
                plain = 0.0 if room or background == "black" else 1.0
                opaque = seen[..., :3] + (1 - seen[..., 3:]) * plain
                save(out / frame["file_path"], np.rint(255 * opaque[..., ::-1]).astype(np.uint8))
            if split == "test" and background != "none":
                depth = depth_map(world_from_camera, views, room)
                frame |= {"depth_file_path": f"depth/{k:03d}.png", "mask_file_path": f"mask/{k:03d}.png"}
                save(out / frame["depth_file_path"], np.rint(depth / DEPTH_SCALE).astype(np.uint16))
                save(out / frame["mask_file_path"], (255 * (seen[..., 3] >= 0.5)).astype(np.uint8))
            frames.append(frame)
        camera = {"camera_angle_x": math.radians(views.angle_deg), "w": views.size, "h": views.size}
        box = {} if background == "none" else {"aabb": (ROOM if room else BOX).tolist(), "depth_scale": DEPTH_SCALE}
        (out / f"transforms_{split}.json").write_text(json.dumps(camera | box | {"frames": frames}, indent=1))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--background", choices=("none", "white", "black", "room"), default="none")
    parser.add_argument("--size", type=int, default=400)
    options = parser.parse_args()
    near = {"distance": 2.4, "angle_deg": 64.0} if options.background == "room" else {}
    make(options.out, options.background, Views(size=options.size, **near))


if __name__ == "__main__":
    main()
