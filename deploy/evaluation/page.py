"""The page of an evaluation: scores, curves, and the answers of each method that were worst, as pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fieldpose.deploy.benchmarks.machine import describe
from fieldpose.deploy.evaluation.running import Examination
from fieldpose.deploy.evaluation.scores import Answer
from fieldpose.deploy.reporting.html_page import columns, figure, gallery, lines, page, plot, section, soft, table
from fieldpose.deploy.reporting.overlay import overlaid, without_distortion
from fieldpose.deploy.reporting.provenance import versions
from fieldpose.deploy.reporting.results import CLOSE, CLOSE_DEG

_PICTURES, _LEAST = 10, 2
"""Of all methods together, and of each."""


@dataclass(frozen=True)
class Evaluation:
    """What was evaluated, in words: the dataset; lines about it; headings and rows of the scores; how methods differ;
    the curves as a png; settings that are not the defaults."""

    dataset: str
    about: Sequence[str]
    scores: tuple[Sequence[str], Sequence[Sequence[str]]]
    differences: Sequence[str]
    curves: bytes
    settings: Mapping[str, str]


def html(evaluation: Evaluation, answers: Mapping[str, Sequence[Answer]], examination: Examination) -> bytes:
    """The file."""
    sections = [
        section("Scores", columns(*evaluation.scores) + lines(evaluation.differences)),
        section("Shares of right poses", plot(evaluation.curves, "Shares of right poses by error")),
        section("The answers that were worst", gallery(_worst(answers, examination))),
        section("Settings that are not the defaults", table(evaluation.settings.items()) or soft("none")),
        section("Made with", table({"machine": describe(), **versions()}.items())),
    ]
    return page("fieldpose evaluate", evaluation.dataset, evaluation.about, "".join(sections))


def worst(answers: Sequence[Answer], count: int) -> list[Answer]:
    """Those without a pose, then those with the largest errors, by the limits of right ones."""

    def badness(answer: Answer) -> float:
        if answer.errors is None:
            return np.inf
        turn, shift = answer.errors
        return max(turn / CLOSE_DEG, shift / CLOSE if answer.scale_known else 0.0)

    return sorted(answers, key=badness, reverse=True)[:count]


def _worst(answers: Mapping[str, Sequence[Answer]], examination: Examination) -> Iterator[str]:
    count = max(_LEAST, _PICTURES // max(1, len(answers)))
    for name, given in answers.items():
        for answer in worst(given, count):
            image = examination.dataset.images[answer.pair.image].name
            yield figure(
                _picture(answer, examination), f"{name}, {image}, seed {answer.pair.seed}", f": {_why(answer)}"
            )


def _why(answer: Answer) -> str:
    guess = "the guess was {:.3g} degrees and {:.3g} units off".format(*answer.pair.guess_error)
    if answer.errors is None:
        return f"no pose; {guess}"
    turn, shift = answer.errors
    shifted = f" and {shift:.3g} units" if answer.scale_known else ""
    return f"{turn:.3g} degrees{shifted} off; {guess}"


def _picture(answer: Answer, examination: Examination) -> np.ndarray:
    """The image (h, 2 w, 3) uint8, and beside it the same with the field over it at the pose that was found."""
    camera = examination.dataset.images[answer.pair.image].camera
    image = without_distortion(examination.images[answer.pair.seed, answer.pair.image], camera)
    pose = answer.cam_from_object
    over = image if pose is None else overlaid(image, examination.renderer.render_view(camera.undistorted(), pose))
    return np.concatenate([image, over], axis=1)
