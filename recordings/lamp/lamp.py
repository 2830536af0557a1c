"""The object: a desk lamp on balanced arms, with a wire basket beside it. No part carries a print."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scene.painting import hex_rgb
from scene.primitives import Vec, ball, box, carried, lathe, plain, ring
from shapes import Material, Part, Plane, frame, knob, plate, rod, spring, wire

FLOOR = -0.95
MIDDLE = (0.0, 0.0, -0.03)
PLANE = Plane((-0.10, 0.06), -18.0)

SHOULDER, ELBOW, WRIST = np.array((0.0, -0.74)), np.array((-0.44, 0.17)), np.array((0.34, 0.80))
LOWER_OFFSET, UPPER_OFFSET = np.array((-0.095, -0.01)), np.array((-0.045, 0.085))
ARM_HALF_WIDTH = 0.04
SHADE_AXIS = np.array((0.35, -0.62, -0.78)) / np.linalg.norm((0.35, -0.62, -0.78))
SOCKET = PLANE.at(WRIST + np.array((0.115, -0.075)))
BASKET = np.array((0.40, 0.33, FLOOR + 0.012))


def _paints() -> dict[str, Material]:
    tones = {
        "green": "#2f5146",
        "cream": "#cfc4a6",
        "brass": "#96804f",
        "rubber": "#262626",
        "steel": "#85898a",
        "red": "#8f4233",
    }
    return {name: plain(hex_rgb(tone), roughness=0.55, specular=0.25) for name, tone in tones.items()}


def _moved(point: np.ndarray, by: Vec) -> np.ndarray:
    return point + np.array(by)


def build() -> list[Part]:
    paints = _paints()
    parts = []
    for make in (_base, _shoulder, _lower_arm, _upper_arm, _joints, _head, _cable, _lead, _basket, _note_holder):
        parts += make(paints)
    return parts


def _base(m: dict[str, Material]) -> list[Part]:
    x, y = PLANE.origin
    turns = np.linspace(-0.15, np.pi / 2, 8)
    rim = [(0.225 + 0.025 * np.cos(a), 0.033 + 0.025 * np.sin(a)) for a in turns]
    profile = [(1e-5, 0.012), (0.235, 0.012), *rim, (0.185, 0.063), (0.17, 0.056), (0.07, 0.068), (1e-5, 0.068)]
    disc = lathe("disc", profile, (x, y, FLOOR), [m["green"]], segments=72)
    foot = lathe("foot", [(1e-5, 0), (0.215, 0), (0.215, 0.013), (1e-5, 0.013)], (x, y, FLOOR), [m["rubber"]])
    band = ring("band", 0.178, 0.006, (x, y, FLOOR + 0.06), m["brass"])
    screws = [_on_base(angle, 0.125, 0.013, 0.012, m["brass"]) for angle in (20, 115, 230)]
    button = _on_base(-62, 0.115, 0.03, 0.028, m["red"])
    label = box("label", (0.11, 0.045, 0.008), (x - 0.115, y - 0.02, FLOOR + 0.064), {"all": m["cream"]}, 0.002)
    label.rotation_euler = (0.0, 0.04, np.radians(100))
    return [disc, foot, band, button, label, *screws]


def _on_base(angle_deg: float, distance: float, radius: float, length: float, material: Material) -> Part:
    a = np.radians(angle_deg)
    x, y = PLANE.origin
    where = (x + distance * np.cos(a), y + distance * np.sin(a), FLOOR + 0.058)
    return knob(where, (0, 0, 1), radius, length, material)


def _shoulder(m: dict[str, Material]) -> list[Part]:
    """The post on the base, its collar and clamp, and the bracket that the lower arm turns on."""
    x, y = PLANE.origin
    post = rod((x, y, FLOOR + 0.06), (x, y, SHOULDER[1] - 0.05), 0.024, m["steel"])
    collar = knob((x, y, FLOOR + 0.065), (0, 0, 1), 0.048, 0.05, m["brass"])
    lever_from = np.array((x, y, FLOOR + 0.095))
    lever = rod(lever_from, _moved(lever_from, (0.06, -0.12, 0.03)), 0.008, m["steel"])
    grip = ball("grip", 0.02, _moved(lever_from, (0.062, -0.124, 0.031)), m["rubber"])
    pivots = [SHOULDER, SHOULDER + LOWER_OFFSET, _lower_anchor(), SHOULDER - (0.0, 0.06)]
    cheeks = [plate(PLANE, pivots, 0.026, t, 0.012, m["green"]) for t in (-0.059, 0.059)]
    block = rod(PLANE.at(SHOULDER - (0, 0.06), -0.06), PLANE.at(SHOULDER - (0, 0.06), 0.06), 0.026, m["steel"])
    return [post, collar, lever, grip, block, *cheeks]


def _lower_anchor() -> np.ndarray:
    return _moved(SHOULDER, (0.085, -0.005))


def _elbow_anchor() -> np.ndarray:
    return _moved(ELBOW, (0.055, -0.085))


def _lower_arm(m: dict[str, Material]) -> list[Part]:
    sides = (-ARM_HALF_WIDTH, ARM_HALF_WIDTH)
    bars = [rod(PLANE.at(SHOULDER, t), PLANE.at(ELBOW, t), 0.013, m["green"]) for t in sides]
    back = rod(PLANE.at(SHOULDER + LOWER_OFFSET), PLANE.at(ELBOW + LOWER_OFFSET), 0.011, m["green"])
    parts = [*bars, back]
    for t, share in ((-0.092, 0.60), (0.092, 0.52)):
        hook = SHOULDER + share * (ELBOW - SHOULDER)
        parts.append(rod(PLANE.at(hook, 0.0), PLANE.at(hook, 1.15 * t), 0.008, m["brass"]))
        parts.append(rod(PLANE.at(_lower_anchor(), 0.0), PLANE.at(_lower_anchor(), 1.15 * t), 0.008, m["brass"]))
        parts.append(spring(PLANE.at(_lower_anchor(), t), PLANE.at(hook, t), 0.024, 0.0068, 0.026, m["steel"]))
    spacer = SHOULDER + 0.82 * (ELBOW - SHOULDER)
    parts.append(rod(PLANE.at(spacer, sides[0]), PLANE.at(spacer, sides[1]), 0.008, m["brass"]))
    return parts


def _upper_arm(m: dict[str, Material]) -> list[Part]:
    sides = (-ARM_HALF_WIDTH, ARM_HALF_WIDTH)
    bars = [rod(PLANE.at(ELBOW, t), PLANE.at(WRIST, t), 0.011, m["green"]) for t in sides]
    top = rod(PLANE.at(ELBOW + UPPER_OFFSET), PLANE.at(WRIST + UPPER_OFFSET), 0.010, m["green"])
    hook = ELBOW + 0.58 * (WRIST - ELBOW)
    pin = rod(PLANE.at(hook, -0.05), PLANE.at(hook, 0.05), 0.008, m["brass"])
    coil = spring(PLANE.at(_elbow_anchor()), PLANE.at(hook), 0.019, 0.0065, 0.025, m["steel"])
    spacer = ELBOW + 0.86 * (WRIST - ELBOW)
    return [*bars, top, pin, coil, rod(PLANE.at(spacer, sides[0]), PLANE.at(spacer, sides[1]), 0.008, m["brass"])]


def _joints(m: dict[str, Material]) -> list[Part]:
    """The plates of elbow and wrist, and a pin through each pivot; the three tightened ones have knobs."""
    elbow = [ELBOW, ELBOW + LOWER_OFFSET, ELBOW + UPPER_OFFSET, _elbow_anchor()]
    wrist = [WRIST, WRIST + UPPER_OFFSET, _moved(WRIST, (0.075, 0.01))]
    parts = [plate(PLANE, elbow, 0.024, t, 0.012, m["cream"]) for t in (-0.06, 0.06)]
    parts += [plate(PLANE, wrist, 0.022, t, 0.012, m["cream"]) for t in (-0.059, 0.059)]
    pivots = [*elbow, *wrist, SHOULDER, SHOULDER + LOWER_OFFSET]
    parts += [rod(PLANE.at(p, -0.074), PLANE.at(p, 0.074), 0.011, m["brass"]) for p in pivots]
    parts.append(knob(PLANE.at(SHOULDER, 0.06), PLANE.across, 0.034, 0.045, m["brass"]))
    parts.append(knob(PLANE.at(ELBOW, -0.06), -PLANE.across, 0.038, 0.05, m["rubber"]))
    parts.append(knob(PLANE.at(WRIST, 0.058), PLANE.across, 0.028, 0.04, m["brass"]))
    return parts


def _head(m: dict[str, Material]) -> list[Part]:
    """The shade hangs from the wrist on a short bent arm and is turned out of the arms' plane."""
    start = PLANE.at(_moved(WRIST, (0.075, 0.01)))
    neck = wire([start, _moved(start, (0.03, -0.01, -0.02)), SOCKET, SOCKET + 0.03 * SHADE_AXIS], 0.014, m["steel"])
    outer = [(1e-5, 0.0), (0.040, 0.0), (0.052, 0.02), (0.052, 0.14), (0.060, 0.155), (0.074, 0.184), (0.203, 0.415)]
    inner = [(0.195, 0.415), (0.066, 0.19), (0.05, 0.165), (1e-5, 0.165)]
    slots = [0] * len(outer) + [1] * (len(inner) - 1)
    parts = [
        lathe("shade", [*outer, *inner], (0, 0, 0), [m["green"], m["cream"]], slots, segments=72),
        ring("lip", 0.2, 0.008, (0, 0, 0.415), m["brass"]),
        ring("seam", 0.053, 0.007, (0, 0, 0.135), m["brass"]),
        ball("bulb", 0.058, (0, 0, 0.29), m["cream"]),
        rod((0, 0, 0.16), (0, 0, 0.25), 0.026, m["brass"], 0.03),
        rod((0.05, 0, 0.075), (0.095, 0, 0.075), 0.009, m["steel"]),
        knob((0.09, 0, 0.075), (1, 0, 0), 0.02, 0.03, m["red"]),
    ]
    carried(parts, frame(SOCKET, SHADE_AXIS))
    return [neck, *parts]


def _cable(m: dict[str, Material]) -> list[Part]:
    """From the base up the arms to the socket, hanging free behind the elbow and before the head."""
    lower, upper = ELBOW - SHOULDER, WRIST - ELBOW
    clips = [SHOULDER + LOWER_OFFSET + share * lower + (-0.025, -0.01) for share in (0.16, 0.72)]
    ties = [ELBOW + UPPER_OFFSET + share * upper + (-0.013, 0.022) for share in (0.22, 0.62)]
    path = [
        PLANE.at((-0.15, FLOOR + 0.05), 0.05),
        PLANE.at((-0.17, FLOOR + 0.14), 0.05),
        *(PLANE.at(clip) for clip in clips),
        PLANE.at(_moved(ELBOW, (-0.21, -0.09)), 0.05),
        PLANE.at(_moved(ELBOW, (-0.235, 0.04)), 0.075),
        PLANE.at(_moved(ELBOW, (-0.13, 0.15)), 0.04),
        *(PLANE.at(tie) for tie in ties),
        PLANE.at(_moved(WRIST, (-0.10, 0.16)), 0.05),
        PLANE.at(_moved(WRIST, (0.04, 0.185)), 0.08),
        PLANE.at(_moved(WRIST, (0.125, 0.09)), 0.04),
        SOCKET + 0.01 * SHADE_AXIS,
    ]
    return [wire(path, 0.011, m["rubber"]), *_clips(m, clips, lower), *_clips(m, ties, upper)]


def _clips(m: dict[str, Material], places: Sequence[np.ndarray], arm: np.ndarray) -> list[Part]:
    """Short sleeves that tie the cable to its rod."""
    half = 0.018 * arm / np.linalg.norm(arm)
    return [rod(PLANE.at(p - half), PLANE.at(p + half), 0.02, m["cream"]) for p in places]


def _lead(m: dict[str, Material]) -> list[Part]:
    """The cable on the floor, with its switch and plug."""
    lift = FLOOR + 0.013
    x, y = PLANE.origin
    spots = [(-0.44, -0.08), (-0.58, -0.02), (-0.68, -0.14), (-0.62, -0.31), (-0.46, -0.36)]
    path = [(x - 0.18, y - 0.09, lift + 0.015), *((*s, lift) for s in spots), (-0.32, -0.42, lift + 0.01)]
    path += [(-0.16, -0.56, lift + 0.01), (0.02, -0.53, lift + 0.012), (0.10, -0.52, lift + 0.012)]
    switch = box("switch", (0.13, 0.05, 0.036), (-0.36, -0.40, lift + 0.01), {"all": m["cream"]}, 0.012)
    rocker = box("rocker", (0.04, 0.028, 0.012), (-0.36, -0.40, lift + 0.03), {"all": m["red"]}, 0.004)
    for thing in (switch, rocker):
        thing.rotation_euler = (0.0, 0.0, np.radians(-28))
    plug = rod((0.09, -0.52, lift + 0.012), (0.20, -0.505, lift + 0.012), 0.016, m["rubber"], 0.03)
    collar = rod((0.20, -0.505, lift + 0.012), (0.222, -0.502, lift + 0.012), 0.034, m["rubber"])
    prongs = [
        rod((0.22, y, lift + 0.012), (0.29, y + 0.009, lift + 0.012), 0.007, m["brass"]) for y in (-0.518, -0.486)
    ]
    return [wire(path, 0.011, m["rubber"]), switch, rocker, plug, collar, *prongs]


def _polar(radius: float, angle_deg: float, height: float) -> np.ndarray:
    a = np.radians(angle_deg)
    return _moved(BASKET, (radius * np.cos(a), radius * np.sin(a), height))


def _basket(m: dict[str, Material]) -> list[Part]:
    """Bent wires between hoops, tied to the base by two bars; a plate hangs on one side."""
    count = 15
    parts = []
    for angle in np.arange(count) * 360 / count:
        bend = [(0.05, 0.0), (0.12, 0.0), (0.145, 0.012), (0.155, 0.05), (0.185, 0.26), (0.205, 0.40)]
        parts.append(wire([_polar(r, angle, z) for r, z in bend], 0.0085, m["brass"], 4))
    hoops = ((0.05, 0.0), (0.15, 0.03), (0.170, 0.155), (0.188, 0.28))
    parts += [ring("hoop", r, 0.0085, _moved(BASKET, (0, 0, z)), m["brass"]) for r, z in hoops]
    parts.append(ring("brim", 0.206, 0.013, _moved(BASKET, (0, 0, 0.40)), m["brass"]))
    x, y = PLANE.origin
    base = np.array((x, y, FLOOR + 0.03))
    for angle in (218, 252):
        end = _polar(0.13, angle, 0.0)
        toward = (end - base) / np.linalg.norm(end - base)
        parts.append(wire([base + 0.22 * toward, base + 0.29 * toward, end], 0.0105, m["steel"], 4))
    tag = box("tag", (0.13, 0.012, 0.075), (0, 0, 0), {"all": m["red"]}, 0.004)
    tag.location, tag.rotation_euler = _polar(0.198, -66, 0.29), (np.radians(-6), 0.0, np.radians(24))
    return [*parts, tag]


def _note_holder(m: dict[str, Material]) -> list[Part]:
    """A tall wire on the basket's hoop that ends in a flat spiral, and an open hook on the other side."""
    foot = _polar(0.150, 75, 0.03)
    top = _polar(0.235, 75, 0.72)
    sideways = (top - _polar(0.0, 75, 0.72)) / 0.235
    spiral = zip(np.linspace(0.5, 4.1, 40) * np.pi, np.linspace(0.08, 0.016, 40), strict=True)
    curl = [top + (r * np.sin(a) - 0.08) * sideways - (0, 0, r * np.cos(a)) for a, r in spiral]
    stem = wire([foot, _polar(0.206, 75, 0.40), _polar(0.225, 75, 0.56), *curl], 0.0095, m["steel"], 3)
    hook = [(0.206, 0.40), (0.235, 0.385), (0.25, 0.32), (0.275, 0.29), (0.30, 0.31), (0.302, 0.345)]
    return [stem, wire([_polar(r, 8, z) for r, z in hook], 0.0095, m["steel"])]
