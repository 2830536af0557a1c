"""Success curves as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from deploy.evaluation.scores import Answer, curve


def plot_success(answers: Mapping[str, Sequence[Answer]], path: Path, title: str) -> None:
    """Share of pairs below each error, by method, rotation and translation side by side."""
    drawing, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    limits = (np.geomspace(0.01, 180, 200), np.geomspace(1e-4, 1, 200))
    for which, (axis, label) in enumerate(zip(axes, ("rotation error, degrees", "translation error"), strict=True)):
        for name, given in answers.items():
            axis.semilogx(limits[which], curve(given, which, limits[which]), label=name)
        axis.set_xlabel(label)
        axis.set_ylabel("share of pairs below")
        axis.set_ylim(0, 1.02)
        axis.grid(visible=True, which="both", alpha=0.3)
    axes[1].legend(loc="lower right")
    drawing.suptitle(title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)
