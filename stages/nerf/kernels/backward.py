"""Backward pass of a packet: from colours and opacities to the networks, the hash grid and the rays."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.packet import MAX_EXPONENT
from fieldpose.stages.nerf.kernels.types import Net, Rays, Samples

FEW = 8
"""Moving the rows costs about as much as the backward pass of an eighth of them."""


@inner
def mask_relu(gradient: np.ndarray, activation: np.ndarray) -> None:
    for i in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            if activation[i, j] <= 0:
                gradient[i, j] = 0


@inner
def shade_backward(rays: Rays, r: int, background: np.ndarray, drgb: np.ndarray) -> None:
    """Seed the gradients of a ray's composited values from that of its colour, drgb (3,)."""
    o = rays.opacity[r]
    total = np.float32(0)
    rays.dfeats[r, :] = 0
    for c in range(3):
        g = drgb[c]
        rays.drgb[r, c] = g * o
        total += g * (rays.rgb[r, c] + np.float32(0.5) - background[c])
    rays.dopacity[r] = total
    rays.ddepth[r] = 0


@njit(nogil=True, fastmath=FASTMATH)
def colour_backward(net: Net, rays: Rays, count: int, drgb: np.ndarray) -> None:
    """Pull rays.drgb back to the composited features and harmonics, and add the features' own colour's gradient."""
    dh2, dh1, dfeats = rays.dh2[:count], rays.dh1[:count], rays.dfeats[:count]
    np.dot(rays.drgb[:count], net.c3.T, dh2)
    mask_relu(dh2, rays.h2)
    np.dot(dh2, net.c2.T, dh1)
    mask_relu(dh1, rays.h1)
    np.dot(dh1, net.c1.T, dfeats)
    for r in range(count):
        for c in range(3):
            dfeats[r, c] += drgb[r, c]


@njit(inline="always")
def spread_coordinate(contracted: bool, t: float) -> float:
    """Distance along the ray as the distortion loss measures it: bounded in contracted space."""
    return t / (np.float32(1) + t) if contracted else t


@inner
def composite_backward(samples: Samples, rays: Rays, count: int, distortion: float, contracted: bool) -> None:
    """Fill samples.dout from the gradients of the composited values.

    d loss / d density_i = dt_i * (T_{i+1} g_i - sum_{j > i} w_j g_j), with g_j the gradient of weight j;
    g_j has the share of the distortion loss, sum_ij w_i w_j |s_i - s_j|, in it.
    """
    features = samples.out.shape[1] - 1
    for r in range(count):
        total_w = total_ws = np.float32(0)
        if distortion > 0:
            s = rays.last[r]
            while s >= 0:
                total_w += samples.weight[s]
                total_ws += samples.weight[s] * spread_coordinate(contracted, samples.t[s])
                s = samples.previous[s]
        behind = behind_w = behind_ws = np.float32(0)
        s = rays.last[r]
        while s >= 0:
            w = samples.weight[s]
            if w <= 0:  # behind where the ray was stopped
                samples.dout[s, :] = 0
                s = samples.previous[s]
                continue
            g = rays.dopacity[r] + rays.ddepth[r] * samples.t[s]
            if distortion > 0:
                at = spread_coordinate(contracted, samples.t[s])
                before_w, before_ws = total_w - behind_w - w, total_ws - behind_ws - w * at
                g += 2 * distortion * (at * (before_w - behind_w) - before_ws + behind_ws)
                behind_w += w
                behind_ws += w * at
            for f in range(features):
                g += rays.dfeats[r, f] * samples.out[s, 1 + f]
                samples.dout[s, 1 + f] = w * rays.dfeats[r, f]
            raw = samples.out[s, 0]
            if raw < MAX_EXPONENT:
                samples.dout[s, 0] = math.exp(raw) * samples.dt[s] * (samples.trans[s] * g - behind)
            else:
                samples.dout[s, 0] = 0
            behind += w * g
            s = samples.previous[s]


@njit(nogil=True, fastmath=FASTMATH)
def density_backward(net: Net, samples: Samples, last: int) -> None:
    """Pull samples.dout back to the hidden layer and the encoding, rows 0..last."""
    dh, dx = samples.dh[:last], samples.dx[:last]
    np.dot(samples.dout[:last], net.w2.T, dh)
    mask_relu(dh, samples.h)
    np.dot(dh, net.w1.T, dx)


@njit(nogil=True, fastmath=FASTMATH)
def compact(samples: Samples, rays: Rays, rows: int) -> int:
    """Drop the rows without weight (behind the surface) where they are many, so that nothing is paid for them."""
    idle = 0
    for s in range(rows):
        idle += samples.weight[s] <= 0
    if idle * FEW <= rows:
        return rows
    keep = 0
    for s in range(rows):
        r = samples.ray[s]
        if samples.weight[s] <= 0:
            continue
        if keep != s:
            for a in range(3):
                samples.u[a, keep] = samples.u[a, s]
            samples.y[keep] = samples.y[s]
            samples.t[keep], samples.dt[keep] = samples.t[s], samples.dt[s]
            samples.x[keep] = samples.x[s]
            samples.h[keep] = samples.h[s]
            samples.out[keep] = samples.out[s]
            samples.weight[keep], samples.trans[keep] = samples.weight[s], samples.trans[s]
            samples.ray[keep] = r
        keep += 1
    rays.last[:] = -1
    for s in range(keep):
        r = samples.ray[s]
        samples.previous[s] = rays.last[r]
        rays.last[r] = s
    return keep
