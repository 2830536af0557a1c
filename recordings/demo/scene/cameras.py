"""Where the cameras stand. Matrices are world_from_cam in OpenGL axes (x right, y up, looking along -z)."""

from __future__ import annotations

import numpy as np

STILL_WIDTH = STILL_HEIGHT = 400
STILL_ANGLE = 0.82
VIDEO_WIDTH, VIDEO_HEIGHT, VIDEO_ANGLE = 480, 360, float(np.radians(55.0))
FRAMES, RATE_HZ = 300, 30.0

# Frame, azimuth, elevation (degrees), distance, and how far the gaze is turned to the right (degrees).
STORY = (
    (0, -38, 30, 3.00, 0),
    (45, -22, 25, 2.80, 2),
    (90, -4, 22, 2.65, 0),
    (120, 46, 27, 2.70, -2),
    (150, -10, 30, 2.75, 0),
    (180, -10, 30, 2.75, 0),
    (219, 4, 26, 2.95, 0),
    (241, 10, 24, 3.05, 47),
    (249, 11, 24, 3.05, 47),
    (271, 15, 25, 2.95, 0),
    (299, 30, 30, 2.75, 0),
)
STILL_FROM, STILL_TO = 150, 180


def spherical(azimuth_deg: float, elevation_deg: float, distance: float) -> np.ndarray:
    """Azimuth 0 is the front of the object (-y), growing to its left hand (+x)."""
    a, e = np.radians((azimuth_deg, elevation_deg))
    return distance * np.array((np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)))


def looking(eye: np.ndarray, target: np.ndarray, roll_deg: float = 0.0) -> np.ndarray:
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    world_from_cam = np.eye(4)
    world_from_cam[:3] = np.stack([c * right + s * up, c * up - s * right, back, eye], axis=1)
    return world_from_cam


def stills(count: int, seed: int) -> list[np.ndarray]:
    """Cameras spread evenly (a Kronecker sequence) over azimuth +-75 and elevation 10..60 degrees."""
    rng = np.random.default_rng(seed)
    steps = (np.arange(1, count + 1)[:, None] * np.array((0.7548776662, 0.5698402910)) + rng.uniform(0, 1, 2)) % 1.0
    poses = []
    for u, v in steps:
        height = np.sin(np.radians(10)) + v * (np.sin(np.radians(60)) - np.sin(np.radians(10)))
        eye = spherical(-75 + 150 * u, float(np.degrees(np.arcsin(height))), rng.uniform(2.3, 2.95))
        target = rng.uniform((-0.3, -0.3, -0.25), (0.3, 0.3, 0.2))
        poses.append(looking(eye, target, rng.uniform(-8, 8)))
    return poses


def eased(frame: np.ndarray) -> np.ndarray:
    """(n, 4) azimuth, elevation, distance and gaze of the story, with rest at each of its knots' turning points."""
    keys = np.array(STORY, float)
    slopes = np.zeros_like(keys[:, 1:])
    steps = np.diff(keys[:, 1:], axis=0) / np.diff(keys[:, :1], axis=0)
    same = steps[:-1] * steps[1:] > 0
    slopes[1:-1][same] = (2 * steps[:-1] * steps[1:] / np.where(same, steps[:-1] + steps[1:], 1.0))[same]
    slopes[0], slopes[-1] = steps[0], steps[-1]
    at = np.clip(np.searchsorted(keys[:, 0], frame, side="right") - 1, 0, len(keys) - 2)
    span = (keys[at + 1, 0] - keys[at, 0])[:, None]
    t = (frame - keys[at, 0])[:, None] / span
    start, end = keys[at, 1:], keys[at + 1, 1:]
    return (
        (1 + 2 * t) * (1 - t) ** 2 * start
        + t * (1 - t) ** 2 * span * slopes[at]
        + t**2 * (3 - 2 * t) * end
        + t**2 * (t - 1) * span * slopes[at + 1]
    )


def tremor(frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, 6) hand movement, rms 1: sines of 0.4..7 Hz whose amplitude falls with the frequency; still at rest."""
    hertz = np.geomspace(0.4, 7.0, 9)
    phase = rng.uniform(0, 2 * np.pi, (6, 9))
    waves = np.sin(2 * np.pi * hertz * frame[:, None, None] / RATE_HZ + phase) / hertz
    waves = waves.sum(axis=-1) / np.sqrt(0.5 * (1 / hertz**2).sum())
    ramp = 8.0
    outside = np.maximum(STILL_FROM - frame, frame - STILL_TO)
    return waves * np.clip(outside / ramp, 0.02, 1.0)[:, None]


def sequence(seed: int) -> list[np.ndarray]:
    frame = np.arange(FRAMES, dtype=float)
    shake = tremor(frame, np.random.default_rng(seed))
    poses = []
    for (azimuth, elevation, distance, gaze), hand in zip(eased(frame), shake, strict=True):
        eye = spherical(azimuth, elevation, distance) + 0.02 * hand[:3]
        yaw = -np.radians(gaze + 0.45 * hand[3])
        turn = np.array(((np.cos(yaw), -np.sin(yaw), 0), (np.sin(yaw), np.cos(yaw), 0), (0, 0, 1)))
        target = eye + turn @ (np.array((0, 0, -0.05 + 0.015 * hand[4])) - eye)
        poses.append(looking(eye, target, 0.8 * hand[5]))
    return poses


def intrinsics(width: int, height: int, angle_x: float) -> dict[str, float]:
    """Pixel (0, 0) is the centre of the top-left pixel, hence the principal point at (w - 1) / 2."""
    focal = 0.5 * width / np.tan(0.5 * angle_x)
    return {
        "camera_angle_x": angle_x,
        "w": width,
        "h": height,
        "fl_x": focal,
        "fl_y": focal,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
    }
