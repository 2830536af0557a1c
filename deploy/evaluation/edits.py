"""Edits of a recorded sequence that put tracking to the test; a new one is a function here and a row in EDITS.

An edit takes shots, numbered and with ascending stamps, and gives them in the order in which they are sent. Its
parameters are the defaults of its keywords, and the first line of its docstring is what users read about it.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np

from fieldpose.deploy.evaluation import effects
from fieldpose.deploy.evaluation.shots import (
    NS_PER_S,
    Shot,
    marked,
    numbered,
    period_ns,
    repainted,
    run_on,
    stretches,
)
from fieldpose.errors import UsageError

Edit = Callable[[list[Shot], np.random.Generator], list[Shot]]


def none(shots: list[Shot], rng: np.random.Generator) -> list[Shot]:
    """the part as it is"""
    return shots


def occluder(
    shots: list[Shot], rng: np.random.Generator, *, covered: float = 0.8, grow_s: float = 2.0, stay_s: float = 1.0,
    leave_s: float = 1.0, every_s: float = 10.0,
) -> list[Shot]:  # fmt: skip
    """a textured thing comes nearer until it covers 80 % of the image, stays, and leaves to one side"""
    for stretch in stretches(shots, rng, grow_s + stay_s + leave_s, every_s):
        shots = repainted(shots, stretch, effects.Occluder.drawn(rng, covered, grow_s, stay_s, leave_s))
    return shots


def gone(shots: list[Shot], rng: np.random.Generator, *, seconds: float = 1.0, every_s: float = 10.0) -> list[Shot]:
    """for 1 s the image shows something else of the same look"""
    for stretch in stretches(shots, rng, seconds, every_s):
        elsewhere = effects.Elsewhere(int(rng.integers(2**32)), rng.uniform(0, 2 * np.pi))
        shots = repainted(shots, stretch, elsewhere)
    return shots


def black(shots: list[Shot], rng: np.random.Generator, *, seconds: float = 0.5, every_s: float = 10.0) -> list[Shot]:
    """0.5 s of black frames"""
    for stretch in stretches(shots, rng, seconds, every_s):
        shots = repainted(shots, stretch, effects.black)
    return shots


def frozen(shots: list[Shot], rng: np.random.Generator, *, seconds: float = 1.0, every_s: float = 10.0) -> list[Shot]:
    """an image is repeated for 1 s, with running stamps, and the sequence goes on from there"""
    period, places = period_ns(shots), stretches(shots, rng, seconds, every_s)
    repeats = max(round(seconds * NS_PER_S / period), 1)
    parts: list[list[Shot]] = []
    done = 0
    for place in places:
        held = shots[place.start]
        copies = [marked(held).at(held.at_ns + k * period) for k in range(repeats)]
        parts += [shots[done : place.start + 1], copies]
        done = place.start + 1
    return run_on([*parts, shots[done:]], period)


def blur(
    shots: list[Shot], rng: np.random.Generator, *, length_px: int = 15, seconds: float = 1.0, every_s: float = 4.0
) -> list[Shot]:
    """motion blur of 15 pixels of the source's images for 1 s at a time, each time in another direction"""
    for stretch in stretches(shots, rng, seconds, every_s):
        shots = repainted(shots, stretch, partial(effects.streaked, length_px, rng.uniform(0, 180)))
    return shots


def exposure(
    shots: list[Shot], rng: np.random.Generator, *, less: float = 0.5, more: float = 2.0, step_s: float = 1.0,
    every_s: float = 5.0,
) -> list[Shot]:  # fmt: skip
    """1 s of half and 1 s of twice the light, in any order, each from one frame to the next"""
    for stretch in stretches(shots, rng, 2 * step_s, every_s):
        gains = (less, more) if rng.random() < 0.5 else (more, less)
        shots = repainted(shots, stretch, partial(effects.stepped, gains, step_s))
    return shots


def flicker(shots: list[Shot], rng: np.random.Generator, *, depth: float = 0.4, mains_hz: float = 50.0) -> list[Shot]:
    """brightness alternates throughout, as lamps on 50 Hz mains (100 Hz light) look to a short exposure"""
    lamps = partial(effects.flickering, depth, 2 * mains_hz, rng.uniform(0, 2 * np.pi))
    return repainted(shots, range(len(shots)), lamps)


def missing(shots: list[Shot], rng: np.random.Generator, *, longest: int = 8) -> list[Shot]:
    """half of the frames are missing, in bursts of up to 8"""
    kept: list[Shot] = []
    at = 0
    while at < len(shots):
        burst = int(rng.integers(1, longest + 1))
        run = shots[at : at + burst]
        kept += [marked(run[0]), *run[1:]] if kept else run
        at += 2 * burst
    return numbered(kept)


def cut(shots: list[Shot], rng: np.random.Generator) -> list[Shot]:
    """cuts to other places: the last third, more or less, changes places with the one before; stamps run on"""
    period = period_ns(shots)
    first, second = (round(len(shots) * rng.uniform(*where)) for where in ((0.25, 0.4), (0.6, 0.75)))
    parts = (shots[:first], shots[second:], shots[first:second])
    begun = [[marked(part[0]), *part[1:]] for part in parts[1:] if part]
    return run_on([parts[0], *begun], period)


def focal(shots: list[Shot], rng: np.random.Generator, *, error: float = 0.05) -> list[Shot]:
    """the camera's focal lengths are 5 % too large or too small; image and truth stay"""
    factor = 1 + float(rng.choice([-error, error]))

    def mistaken(shot: Shot) -> Shot:
        camera = shot.frame.camera
        camera = msgspec.structs.replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        return marked(replace(shot, frame=replace(shot.frame, camera=camera)))

    return [mistaken(shot) for shot in shots]


def swapped(shots: list[Shot], rng: np.random.Generator, *, share: float = 0.1) -> list[Shot]:
    """now and then two neighbours are sent in the wrong order, each with its own number and stamp

    So frame_ids ascend as the frames were taken, not as they are sent: 0 2 1 3.
    """
    result, at = list(shots), 0
    while at + 1 < len(shots):
        if exchanged := rng.random() < share:
            result[at : at + 2] = marked(shots[at + 1]), marked(shots[at])
        at += 2 if exchanged else 1
    return result


def stamps(shots: list[Shot], rng: np.random.Generator, *, jitter_ms: float = 20.0, wrong: float = 0.1) -> list[Shot]:
    """stamps are off by up to 20 ms, and one in ten is that of the frame before, or earlier still"""
    jittered = [shot.at_ns + round(rng.uniform(-jitter_ms, jitter_ms) * 1e6) for shot in shots]
    result = []
    for i, shot in enumerate(shots):
        at_ns = jittered[i]
        if i and rng.random() < wrong:
            at_ns = jittered[i - 1] - round(rng.choice([0.0, rng.uniform(0, jitter_ms)]) * 1e6)
        result.append(marked(shot.at(max(at_ns, 0))))
    return result


EDITS: dict[str, Edit] = {
    edit.__name__: edit
    for edit in (
        none, occluder, gone, black, frozen, blur, exposure, flicker, missing, cut, focal, swapped, stamps,
    )
}  # fmt: skip


def edit_of(name: str) -> Edit:
    """The edit of that name. Raises UsageError where there is none."""
    if name not in EDITS:
        near = difflib.get_close_matches(name, EDITS, n=2, cutoff=0.6)
        hint = f"did you mean {' or '.join(near)}?" if near else f"expected one of {', '.join(EDITS)}"
        raise UsageError(f"edit {name!r}: {hint}")
    return EDITS[name]


def parameters_of(edit: Edit) -> dict[str, float]:
    """The numbers that an edit works with, by name."""
    named = inspect.signature(edit).parameters.values()
    return {parameter.name: parameter.default for parameter in named if parameter.kind is parameter.KEYWORD_ONLY}


def described() -> str:
    """Every edit with what it does, for users."""
    return "; ".join(f"{name}: {(inspect.getdoc(edit) or '').splitlines()[0]}" for name, edit in EDITS.items())
