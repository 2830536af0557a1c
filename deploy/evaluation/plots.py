"""Pictures of an evaluation: success curves, how true the covariances are, how far methods reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from fieldpose.deploy.evaluation.scores import DIMENSIONS, Answer, curve, tells_translations

Answers = Mapping[str, Sequence[Answer]]

_BINS = 9
_COLOURS = 10


def plot_success(answers: Answers, path: Path | IO[bytes], title: str) -> None:
    """Share of pairs below each error, and share of true poses inside each ellipsoid, by method."""
    drawing, axes = plt.subplots(1, 3, figsize=(14, 4.6), layout="constrained")
    limits = (np.geomspace(0.01, 180, 200), np.geomspace(1e-4, 10, 200))
    for which, (axis, label) in enumerate(zip(axes, ("rotation error, degrees", "translation error"), strict=False)):
        for name, given in answers.items():
            if which == 0 or tells_translations(given):
                axis.semilogx(limits[which], curve(given, which, limits[which]), label=name, **_style(answers, name))
        _framed(axis, label, "share of pairs below")
    _calibration(axes[2], answers)
    drawing.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    _save(drawing, path, title)


def plot_reach(answers: Answers, path: Path | IO[bytes], title: str, diameter: float | None) -> None:
    """Share of right poses by how far the guess was turned, and by how far it was shifted.

    Shifts are in object diameters, or in field units where the diameter is not known.
    """
    drawing, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for which, unit in ((0, 1.0), (1, diameter or 1.0)):
        for name, given in answers.items():
            if tells_translations(given):
                middles, shares = _binned([a for a in given if _turned(a) == (which == 0)], which, unit)
                axes[which].plot(middles, shares, marker="o", markersize=4, label=name, **_style(answers, name))
    _framed(axes[0], "turn of the guess, degrees", "share of right poses")
    _framed(axes[1], f"shift of the guess, {'object diameters' if diameter else 'units'}", "share of right poses")
    drawing.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    _save(drawing, path, title)


def _style(answers: Answers, name: str) -> dict[str, Any]:
    """A colour of its own for each of ten methods, and dashes for those beyond."""
    place = list(answers).index(name)
    return {"color": f"C{place % _COLOURS}", "linestyle": "-" if place < _COLOURS else "--"}


def _turned(answer: Answer) -> bool:
    return answer.pair.guess_error[0] > 1e-3


def _binned(answers: Sequence[Answer], which: int, unit: float) -> tuple[list[float], list[float]]:
    """Middles of the bins that have any answers, and the shares of right ones."""
    sizes = np.array([answer.pair.guess_error[which] / unit for answer in answers])
    edges = np.linspace(0, sizes.max(initial=0.0) * (1 + 1e-9), _BINS + 1)
    right = np.array([answer.right for answer in answers])
    places = np.clip(np.digitize(sizes, edges) - 1, 0, len(edges) - 2)
    bins = np.unique(places)
    return [float(edges[i : i + 2].mean()) for i in bins], [float(right[places == i].mean()) for i in bins]


def _calibration(axis: Axes, answers: Answers) -> None:
    probabilities = np.linspace(0, 1, 101)
    axis.plot([0, 1], [0, 1], color="black", linewidth=0.8, linestyle="--")
    for name, given in answers.items():
        squared = np.array([d for answer in given if (d := answer.mahalanobis_squared) is not None])
        if len(squared):
            inside = [(squared <= limit).mean() for limit in chi2.ppf(probabilities, DIMENSIONS)]
            axis.plot(probabilities, inside, label=name, **_style(answers, name))
    _framed(axis, "probability of the ellipsoid", "share of true poses inside")


def _framed(axis: Axes, x_label: str, y_label: str) -> None:
    axis.set_xlabel(x_label)
    axis.set_ylabel(y_label)
    axis.set_ylim(0, 1.02)
    axis.grid(visible=True, alpha=0.3)


def _save(drawing: Figure, path: Path | IO[bytes], title: str) -> None:
    drawing.suptitle(title, fontsize=10, parse_math=False)
    if isinstance(path, Path):
        path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    plt.close(drawing)
