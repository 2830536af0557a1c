"""Forward pass of a packet of rays: encode, density network, compositing, colour network."""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.nerf.kernels.encoding import encode
from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.layers import layer
from fieldpose.stages.nerf.kernels.march import advance, begin
from fieldpose.stages.nerf.kernels.types import SH_SIZE, Domain, Net, Rays, Samples
from fieldpose.stages.nerf.kernels.vectors import COLUMNS, add_row, float_of_bits

# Numba compiles a function anew for each literal that it is called with: np.int64(0) and np.bool_(True) are none.
MAX_EXPONENT, MIN_EXPONENT = np.float32(11.0), np.float32(-80.0)
HALF = np.float32(0.5)
LOG2_E = np.float32(1.4426950408889634)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
THICKEST = np.float32(80)
HALF_TO_SMALLEST = np.float32(20.03)
"""Logarithm of 0.5 / 1e-9: no step takes away more than that of what is left."""
NONE, LEAST = np.float32(0), np.float32(-np.inf)


@inner
def density_network(net: Net, samples: Samples, first: int, last: int) -> None:
    """Fill x, h and out of rows first..last."""
    encode(net, samples, first, last)
    layer(samples.x, net.w1, NONE, first, last, samples.h)
    layer(samples.h, net.w2, LEAST, first, last, samples.out)


@njit(inline="always")
def exponential(x: float) -> float:
    """exp(x) to 3e-7 of itself for -87 <= x <= 88, in a form that vectorises: 2^n times a polynomial."""
    n = np.floor(x * LOG2_E + HALF)
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    p = np.float32(1 / 120) + r * np.float32(1 / 720)
    p = np.float32(1 / 6) + r * (np.float32(1 / 24) + r * p)
    p = np.float32(1) + r * (np.float32(1) + r * (np.float32(1 / 2) + r * p))
    return p * float_of_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))


@njit(inline="always")
def density(raw: float) -> float:
    return exponential(max(min(raw, MAX_EXPONENT), MIN_EXPONENT))


@inner
def attenuate(samples: Samples, first: int, last: int) -> None:
    """Fill trans of rows first..last with what each lets through of the light that reaches it."""
    out, dt, trans = samples.out.reshape(-1), samples.dt, samples.trans
    width = np.uint64(samples.out.shape[1])
    for s in range(first, last):
        trans[np.uint64(s)] = out[np.uint64(s) * width]
    for s in range(first, last):
        q = np.uint64(s)
        trans[q] = exponential(-min(density(trans[q]) * dt[q], THICKEST))


@njit(inline="always")
def log_up_to_two(x: float) -> float:
    """log(x) to 2e-6 for 1 <= x <= 2: twice the areatangent of (x - 1) / (x + 1)."""
    z = (x - np.float32(1)) / (x + np.float32(1))
    q = z * z
    p = np.float32(1 / 7) + q * (np.float32(1 / 9) + q * np.float32(1 / 11))
    return np.float32(2) * z * (np.float32(1) + q * (np.float32(1 / 3) + q * (np.float32(1 / 5) + q * p)))


@njit(inline="always")
def half_way(before: float, thickness: float) -> float:
    """Which share of a step of this optical thickness leaves half of all light, if at least that reaches the step."""
    to_half = log_up_to_two(before / HALF)
    return to_half / min(thickness, to_half + HALF_TO_SMALLEST)


@inner
def composite(samples: Samples, first: int, last: int, stop_below: float, rays: Rays) -> None:
    """Accumulate rows first..last into their rays, and end the rays whose transmittance falls below the limit.

    A ray's rows stand together.
    """
    out, sums, width = samples.out.reshape(-1), rays.sums.reshape(-1), samples.out.shape[1]
    attenuate(samples, first, last)
    s = first
    while s < last:
        r = samples.ray[s]
        after, opacity, depth = rays.trans[r], rays.opacity[r], rays.depth[r]
        while s < last and samples.ray[s] == r:
            before = after
            if before < stop_below:
                samples.weight[s], samples.trans[s] = 0, before
                s += 1
                continue
            after = before * samples.trans[s]
            weight = before - after
            samples.weight[s], samples.trans[s] = weight, after
            opacity += weight
            depth += weight * samples.t[s]
            if before >= HALF and after < HALF:
                share = half_way(before, density(out[s * width]) * samples.dt[s])
                rays.median[r] = samples.t[s] + samples.dt[s] * (share - HALF)
            if width == COLUMNS:
                add_row(weight, out, s * width, sums, r * width)
            else:
                for f in range(width):
                    sums[r * width + f] += weight * out[s * width + f]
            s += 1
        rays.trans[r], rays.opacity[r], rays.depth[r] = after, opacity, depth
        if after < stop_below:
            rays.alive[r] = False


@inner
def harmonics(d: np.ndarray, out: np.ndarray, at: int) -> None:
    """Real spherical harmonics of degree 0 to 3 of the unit direction d, written to out[at:at + 16]."""
    x, y, z = d[0], d[1], d[2]
    xx, yy, zz = x * x, y * y, z * z
    values = (
        0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
        1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (3 * zz - 1), -1.09254843 * x * z,
        0.54627422 * (xx - yy), 0.59004359 * y * (yy - 3 * xx), 2.89061144 * x * y * z,
        0.45704580 * y * (1 - 5 * zz), 0.37317633 * z * (5 * zz - 3), 0.45704580 * x * (1 - 5 * zz),
        1.44530572 * z * (xx - yy), 0.59004359 * x * (3 * yy - xx),
    )  # fmt: skip
    for i in range(16):
        out[at + i] = values[i]


@inner
def colour_network(net: Net, count: int, rays: Rays) -> None:
    """Fill the view-dependent part of the colour, rays.rgb, from the composited features."""
    features = rays.feats.shape[1] - SH_SIZE
    for r in range(count):
        for f in range(features):
            rays.feats[r, f] = rays.sums[r, 1 + f]
        harmonics(rays.lines[3:6, r], rays.feats[r], features)
    zero = np.int64(0)
    layer(rays.feats, net.c1, NONE, zero, count, rays.h1)
    layer(rays.h1, net.c2, NONE, zero, count, rays.h2)
    layer(rays.h2, net.c3, LEAST, zero, count, rays.rgb)


@njit(inline="always")
def shade(rays: Rays, r: int, channel: int, background: float) -> float:
    """Colour of a ray: 0.5 and the features' own colour, the view-dependent part, the background behind."""
    o = rays.opacity[r]
    return rays.feats[r, channel] + o * (rays.rgb[r, channel] + np.float32(0.5)) + (np.float32(1) - o) * background


@njit(inline="always")
def surface(rays: Rays, r: int) -> float:
    """Where the surface is: the median, which haze in front does not shift, or the mean of what is half open."""
    if rays.median[r] > 0:
        return rays.median[r]
    return rays.depth[r] / rays.opacity[r] if rays.opacity[r] > np.float32(1e-4) else np.float32(0)


@inner
def forward(
    net: Net,
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    jitter: np.ndarray,
    first: int,
    count: int,
    per_ray: int,
    stop_below: float,
    keep: bool,
    samples: Samples,
    rays: Rays,
) -> tuple[int, int]:
    """Trace rays first..first+count (unit directions); return the rows kept and the samples evaluated.

    With `keep` the rows of all rounds stay, for the backward pass; without, each round reuses them.
    """
    begin(dom, origins, directions, jitter, first, count, rays)
    return trace(net, dom, count, per_ray, stop_below, keep, samples, rays)


@inner
def trace(
    net: Net,
    dom: Domain,
    count: int,
    per_ray: int,
    stop_below: float,
    keep: bool,
    samples: Samples,
    rays: Rays,
) -> tuple[int, int]:
    """`forward`, of rays that have begun."""
    row, evaluated = np.int64(0), 0
    while True:
        start = row if keep else np.int64(0)
        row = advance(dom, count, per_ray, start, rays, samples)
        if row == start:
            break
        density_network(net, samples, start, row)
        composite(samples, start, row, stop_below, rays)
        evaluated += row - start
    if evaluated > 0:
        colour_network(net, count, rays)
    else:
        rays.rgb[:count] = 0
        rays.feats[:count] = 0
    return row, evaluated
