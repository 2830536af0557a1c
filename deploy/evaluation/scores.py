"""What answers are worth: errors, shares of success, and whether the stated covariance is true.

The keys of a method's scores, which programs may rely on:
  pairs              how many pairs it was given
  share_re_below_5deg, share_te_below_0.05  over all pairs; no pose is a failure
  share_both_below   over all pairs: both errors below their limits
  share_ok           pairs that got a pose
  share_ok_right     of these, the ones with both errors below their limits
  mean_re_deg, median_re_deg, p90_re_deg, mean_te, median_te, p90_te   over the pairs with a pose; null without any
  seconds_per_image  mean, all passes and refinement included
  stage_ms           {stage: mean}, of all passes, over the pairs with a pose, 0 where one did without the
                     stage; null for a published method, and without any pose
  covariance         {50, 90, 99}: share of the true poses inside the ellipsoid of that probability; null without any
  add                {diameter, add_below_0.1d, add_s_below_0.1d, auc_add, auc_add_s}: see deploy.evaluation.surface;
                     null without a surface
  share_of_solvable  of the pairs that any of the methods run answered rightly, the share that this one has right
What speaks of translations is null for a method that cannot tell them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import chi2

from fieldpose.deploy.evaluation.pairs import Pair
from fieldpose.deploy.evaluation.surface import SHARE, Surface, add, add_s, area_under_curve
from fieldpose.deploy.reporting.results import CLOSE, CLOSE_DEG
from fieldpose.stages.geometry import mahalanobis_squared, rotation_error_deg, translation_error

CAP_DEG, CAP = 4 * CLOSE_DEG, 4 * CLOSE
"""Where errors are capped for comparisons, in degrees and in units of the field: four times the limits."""
_RESAMPLES = 2000
DIMENSIONS = 6
_PROBABILITIES = (50, 90, 99)


@dataclass(frozen=True)
class Answer:
    """A method's answer to a pair; the pose is None where it found none, its translation nothing if not scale_known."""

    pair: Pair
    cam_from_object: np.ndarray | None
    covariance: np.ndarray | None
    seconds: float
    scale_known: bool = True
    stage_ms: Mapping[str, float] = field(default_factory=dict)

    @property
    def errors(self) -> tuple[float, float] | None:
        """Rotation in degrees and translation; None without a pose."""
        pose, truth = self.cam_from_object, self.pair.truth
        return None if pose is None else (rotation_error_deg(pose, truth), translation_error(pose, truth))

    @property
    def right(self) -> bool:
        """Whether there is a pose with both errors below their limits."""
        errors = self.errors
        return errors is not None and self.scale_known and errors[0] < CLOSE_DEG and errors[1] < CLOSE

    @property
    def mahalanobis_squared(self) -> float | None:
        """The error by the stated covariance of the left twist (6, 6); None without one."""
        if self.cam_from_object is None or self.covariance is None:
            return None
        return mahalanobis_squared(self.cam_from_object, self.covariance, self.pair.truth)


def tells_translations(answers: Sequence[Answer]) -> bool:
    """Whether the translations of all answers mean anything."""
    return all(answer.scale_known for answer in answers)


def score(answers: Sequence[Answer], surface: Surface | None = None) -> dict[str, Any]:
    """The scores of one method over its pairs."""
    errors = [answer.errors for answer in answers]
    found = np.array([error for error in errors if error is not None]).reshape(-1, 2)
    close = found < (CLOSE_DEG, CLOSE)
    count, scale_known = len(answers), tells_translations(answers)
    distances = [d for answer in answers if (d := answer.mahalanobis_squared) is not None]
    return {
        "pairs": count,
        "share_re_below_5deg": float(close[:, 0].sum() / count),
        "share_te_below_0.05": float(close[:, 1].sum() / count) if scale_known else None,
        "share_both_below": float(close.all(axis=1).sum() / count) if scale_known else None,
        "share_ok": len(found) / count,
        "share_ok_right": float(close.all(axis=1).mean()) if len(found) and scale_known else None,
        **_statistics("re_deg", found[:, 0]),
        **_statistics("te", found[:, 1] if scale_known else found[:0, 1]),
        "seconds_per_image": float(np.mean([answer.seconds for answer in answers])),
        "stage_ms": _stage_means([answer.stage_ms for answer in answers if answer.errors is not None]),
        "covariance": coverage(distances),
        "add": _surface_scores(answers, surface) if surface is not None and scale_known else None,
    }


def share_of_solvable(answers: Sequence[Answer], others: Sequence[Sequence[Answer]]) -> float | None:
    """Of the pairs that any method answered rightly, the share that these answers have right.

    None without any such pair, and for a method that cannot tell translations.
    """
    if not tells_translations(answers):
        return None
    solvable = {id(a.pair) for given in [answers, *others] for a in given if a.right}
    asked = [answer for answer in answers if id(answer.pair) in solvable]
    return float(np.mean([answer.right for answer in asked])) if asked else None


def _statistics(name: str, values: np.ndarray) -> dict[str, float | None]:
    if len(values) == 0:
        return {f"{what}_{name}": None for what in ("mean", "median", "p90")}
    return {
        f"mean_{name}": float(values.mean()),
        f"median_{name}": float(np.median(values)),
        f"p90_{name}": float(np.quantile(values, 0.9)),
    }


def _stage_means(stage_ms: Sequence[Mapping[str, float]]) -> dict[str, float] | None:
    stages = dict.fromkeys(stage for ms in stage_ms for stage in ms)
    return {stage: float(np.mean([ms.get(stage, 0.0) for ms in stage_ms])) for stage in stages} or None


def coverage(distances: Sequence[float]) -> dict[str, float] | None:
    """By percentage, the share of poses whose region of so much holds the truth, by squared Mahalanobis distances."""
    if not distances:
        return None
    squared = np.array(distances)
    return {str(p): float((squared <= chi2.ppf(p / 100, DIMENSIONS)).mean()) for p in _PROBABILITIES}


def _surface_scores(answers: Sequence[Answer], surface: Surface) -> dict[str, float]:
    poses = [(answer.cam_from_object, answer.pair.truth) for answer in answers]
    end = SHARE * surface.diameter
    scores = {"diameter": surface.diameter}
    for name, measure in (("add", add), ("add_s", add_s)):
        errors = [np.inf if pose is None else measure(pose, truth, surface) for pose, truth in poses]
        scores[f"{name}_below_{SHARE}d"] = float((np.array(errors) < end).mean())
        scores[f"auc_{name}"] = area_under_curve(errors, end)
    return scores


def difference(first: Sequence[Answer], second: Sequence[Answer]) -> dict[str, Any]:
    """How much larger the first method's errors are, pair by pair: mean and its 95 % interval, by the bootstrap.

    re_deg and te are over the `pairs_answered` by both. capped_re_deg and capped_te are over all `pairs` that both were
    given, with errors of at most CAP_DEG and CAP, which a missing pose has too: a few lost poses do not drown the rest.
    Guesses of one image are not independent, so that images are resampled. te is null where a method cannot tell
    translations.
    """
    given = {id(answer.pair): answer for answer in second}
    asked = [(answer, given[id(answer.pair)]) for answer in first if id(answer.pair) in given]
    both = [(a, b) for a, b in asked if a.errors and b.errors]
    scale_known = tells_translations((*first, *second))
    figures: dict[str, Any] = {"pairs": len(asked), "pairs_answered": len(both)}
    for prefix, compared, errors in (("", both, lambda answer: answer.errors), ("capped_", asked, _capped)):
        gaps = np.array([np.subtract(errors(a), errors(b)) for a, b in compared])
        turn, shift = _interval(gaps, np.array([a.pair.image for a, _ in compared]))
        figures |= {f"{prefix}re_deg": turn, f"{prefix}te": shift if scale_known else None}
    return figures


def _capped(answer: Answer) -> tuple[float, float]:
    turn, shift = answer.errors or (CAP_DEG, CAP)
    return min(turn, CAP_DEG), min(shift, CAP)


def _interval(gaps: np.ndarray, groups: np.ndarray) -> list[dict[str, float] | None]:
    """{mean, low, high} of each column of (n, 2), groups (n,) resampled as wholes; None without rows."""
    if len(gaps) == 0:
        return [None, None]
    names, members = np.unique(groups, return_inverse=True)
    sums, counts = np.zeros((len(names), 2)), np.bincount(members)
    np.add.at(sums, members, gaps)
    places = np.random.default_rng(0).integers(0, len(names), (_RESAMPLES, len(names)))
    means = sums[places].sum(axis=1) / counts[places].sum(axis=1)[:, None]
    low, high = np.quantile(means, (0.025, 0.975), axis=0)
    mean = gaps.mean(axis=0)
    return [{"mean": float(mean[i]), "low": float(low[i]), "high": float(high[i])} for i in (0, 1)]


def curve(answers: Sequence[Answer], which: int, limits: np.ndarray) -> np.ndarray:
    """Share of all pairs whose rotation (`which` 0) or translation (1) error is below each limit."""
    errors = np.array([np.inf if answer.errors is None else answer.errors[which] for answer in answers])
    return np.array([(errors < limit).mean() for limit in limits])
