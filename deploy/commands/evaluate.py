"""How well poses are found on a dataset, method by method over the same pairs."""

from __future__ import annotations

import dataclasses
import io
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from fieldpose.deploy.commands.run import INTERRUPTED
from fieldpose.deploy.evaluation import words
from fieldpose.deploy.reporting.output import check_writable, write_bytes, write_json
from fieldpose.deploy.settings import Settings
from fieldpose.errors import UsageError

if TYPE_CHECKING:
    from fieldpose.deploy.evaluation.occlusion import DrawThing
    from fieldpose.deploy.evaluation.pairs import Protocol
    from fieldpose.deploy.evaluation.running import Examination
    from fieldpose.deploy.evaluation.scores import Answer
    from fieldpose.deploy.evaluation.surface import Surface
    from fieldpose.stages.nerf.datasets import Dataset
    from fieldpose.stages.nerf.field import Field
    from fieldpose.stages.nerf.rendering_api import RayRenderer

_WRITTEN_EVERY_S = 60.0


@dataclass(frozen=True)
class Options:
    """Draw guesses near the true poses of held-out images, as the published evaluations do, and score the answers.

    Example: fieldpose evaluate out/lego.safetensors ../shared/data/lego --method one-step --method full

    nerf-synthetic: 5 images, 5 guesses each, turned by 10 to 40 degrees about the origin and shifted by up to 0.2;
    llff: up to 40 degrees and 0.1; occluded: the same, with things pasted over a part of the image; reach: alternately
    turned by up to 180 degrees or shifted by up to the object's diameter. The same seed gives the same pairs for
    every method; slow ones get a part of them (--slow-pairs). Methods take turns, image by image, so that their times
    can be compared.

    The JSON file, written each minute with what there is and in the end, has: protocol, unit, pairs, seeds, covered,
    diameter, interrupted (whether it was ended by Ctrl-C, or is not done yet), methods (name -> pairs,
    share_re_below_5deg, share_te_below_0.05, share_both_below, share_ok, share_ok_right, share_of_solvable,
    mean_re_deg, median_re_deg, p90_re_deg, mean_te, median_te, p90_te, seconds_per_image, stage_ms, covariance, add),
    differences (name -> than, and the mean and 95 % interval of how much larger its errors are than that method's,
    also with errors capped at 20 degrees and 0.2, a missing pose being so wrong).
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors)."""
    dataset: tyro.conf.Positional[Path]
    """The dataset; its held-out images are used."""
    protocol: Literal["nerf-synthetic", "llff", "occluded", "reach"] = "nerf-synthetic"
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """one-step, one-step-unmined, passes and full are the default; also one-step-refined, with -anywhere or -adam,
    retrieved and retrieved-refined (from the training view most like the image, whatever the guess is), and the
    published inerf, inerf-2048, pi-nerf, pi-nerf-camera, essential; may be given several times, or all."""
    seeds: tuple[int, ...] = (0, 1, 2, 3)
    images: int = 5
    """Held-out images a seed."""
    poses: int = 0
    """Guesses an image; 0: what the protocol has, 5, or 10 for reach."""
    angle_deg: tuple[float, float] | None = None
    """Turn the guesses by other angles than the protocol's."""
    shift: float | None = None
    """Shift them by up to another length."""
    turn_about: Literal["origin", "camera"] = "origin"
    """Turn them about the dataset's origin, or the camera about itself."""
    occluders: Path | None = None
    """Dataset with transparent backgrounds whose objects are pasted over occluded images; blobs are painted if none
    is given."""
    surface: Path | None = None
    """Points (n, 3) of the object's surface (.npy) for the ADD scores; taken from the field where none are given."""
    slow_pairs: int = 25
    """Give methods that take seconds an image only so many of the pairs, evenly spread; 0: all."""
    size: int = 400
    """Shrink images whose longer side has more pixels."""
    json: Path | None = None
    """Write the scores into this file."""
    plot: Path | None = None
    """Write success curves into this file (.png)."""
    report: Path | None = None
    """Write a page with the scores, the curves and the answers that were worst as pictures into this folder:
    report.html."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Evaluate, print the table."""
        from fieldpose.deploy.evaluation import pairs
        from fieldpose.deploy.evaluation.running import Examination, shown
        from fieldpose.stages.nerf.datasets import load_dataset
        from fieldpose.stages.nerf.field import load_field
        from fieldpose.stages.nerf.framing import in_dataset_frame
        from fieldpose.stages.nerf.loading import make_renderer, warm_up
        from fieldpose.stages.nerf.training_views import training_views

        page = None if self.report is None else self.report / "report.html"
        check_writable(self.json, self.plot, page)
        self._check()
        field = load_field(self.field)
        # Shifts and scores of the protocols are lengths of the dataset.
        field.metadata = in_dataset_frame(field.metadata)
        names = self._methods(recalls=field.descriptors is not None)
        renderer = make_renderer(field, threads=0, backend=self.settings.backend)
        dataset, surface = load_dataset(self.dataset, "test", self.size), self._surface(field, renderer)
        protocol = self._protocol(surface)
        drawn = pairs.draw(protocol, [record.cam_from_object for record in dataset.images], self.seeds)
        images, covered = shown(dataset, drawn, self._thing(protocol))
        examination = Examination(renderer, training_views(field), dataset, images, drawn)
        warm_up(renderer, jacobian=True)
        about = {
            "protocol": dataclasses.asdict(protocol),
            "unit": dataset.unit,
            "pairs": len(drawn),
            "seeds": list(self.seeds),
            "covered": covered,
            "diameter": None if surface is None else surface.diameter,
        }
        answers: dict[str, list[Answer]] = {name: [] for name in names}
        interrupted = not self._fill(answers, examination, about, surface)
        answers = {name: given for name, given in answers.items() if given}
        if not answers:
            return INTERRUPTED
        figures = {**about, "interrupted": interrupted, **_scores(answers, surface)}
        write_json(self.json, figures)
        if self.plot is not None:
            self._draw(answers, surface, self.plot)
        words.print_scores(figures)
        if page is not None:
            write_bytes(page, self._page(answers, surface, examination, figures))
            print(f"{page}: a page of the scores")
        _warn_of_training_images(field, dataset)
        return INTERRUPTED if interrupted else 0

    def _fill(
        self, answers: Mapping[str, list[Answer]], examination: Examination, about: Mapping[str, Any],
        surface: Surface | None,
    ) -> bool:  # fmt: skip
        """Gather what the methods answer, and write what there is now and then; False where Ctrl-C ended it."""
        written = time.monotonic()
        try:
            with closing(examination.answers(list(answers), self.settings, self.slow_pairs)) as given:
                for name, answer in given:
                    answers[name].append(answer)
                    if self.json is not None and time.monotonic() - written > _WRITTEN_EVERY_S:
                        write_json(self.json, {**about, "interrupted": True, **_scores(answers, surface)})
                        written = time.monotonic()
        except KeyboardInterrupt:
            return False
        return True

    def _check(self) -> None:
        """Raises UsageError for numbers that mean nothing, and for flags that would do nothing."""
        if self.images < 1 or self.poses < 0 or self.slow_pairs < 0 or not self.seeds or min(self.seeds) < 0:
            raise UsageError(
                "--images must be at least 1, --poses and --slow-pairs at least 0, --seeds one or more from 0 on"
            )
        if self.shift is not None and not 0 <= self.shift < float("inf"):
            raise UsageError(f"--shift {self.shift}: expected a length of 0 or more")
        least, most = self.angle_deg or (0, 0)
        if not 0 <= least <= most <= 180:
            raise UsageError(f"--angle-deg {least:g} {most:g}: expected 0 <= least <= most <= 180")
        if self.occluders is not None and self.protocol != "occluded":
            raise UsageError(f"--occluders does nothing with --protocol {self.protocol}; use --protocol occluded")
        if self.plot is not None and self.plot.suffix != ".png":
            raise UsageError(f"--plot {self.plot}: expected a name that ends with .png")

    def _methods(self, recalls: bool) -> Sequence[str]:
        """Their names. `recalls`: whether the field remembers how its training views look."""
        from fieldpose.deploy.evaluation.methods import DEFAULT, METHODS

        possible = tuple(name for name, method in METHODS.items() if recalls or not method.recalls)
        if "all" in self.method:
            return possible
        for name in self.method:
            if name not in METHODS:
                raise UsageError(f"method {name!r}: expected all, or one of {', '.join(METHODS)}")
            if name not in possible:
                raise UsageError(f"method {name!r}: {self.field} does not know how its views look; train it again")
        return tuple(dict.fromkeys(self.method)) or DEFAULT

    def _protocol(self, surface: Surface | None) -> Protocol:
        from fieldpose.deploy.evaluation.pairs import PROTOCOLS

        protocol = PROTOCOLS[self.protocol]
        shift = protocol.max_translation if self.shift is None else self.shift
        if protocol.in_turn and self.shift is None:
            if surface is None:
                raise UsageError("reach: shifts are shares of the object's diameter, which is not known; give --shift")
            shift = surface.diameter
        return dataclasses.replace(
            protocol, images=self.images, poses=self.poses or protocol.poses, turn_about=self.turn_about,
            angle_deg=self.angle_deg or protocol.angle_deg, max_translation=shift,
        )  # fmt: skip

    def _surface(self, field: Field, renderer: RayRenderer) -> Surface | None:
        """The object's surface; None for a scene without bounds."""
        from fieldpose.deploy.evaluation.surface import read_surface, surface_of

        if self.surface is not None:
            return read_surface(self.surface)
        if field.metadata.space.corners is None:
            return None
        return surface_of(renderer, field.metadata.cameras, np.random.default_rng(0))

    def _thing(self, protocol: Protocol) -> DrawThing | None:
        """What is pasted over the images."""
        from fieldpose.deploy.evaluation.occlusion import objects_of, painted
        from fieldpose.stages.nerf.datasets import load_dataset

        if not protocol.occluded:
            return None
        return painted if self.occluders is None else objects_of(load_dataset(self.occluders, "test", self.size))

    def _page(
        self, answers: Mapping[str, Sequence[Answer]], surface: Surface | None, examination: Examination,
        figures: dict[str, Any],
    ) -> bytes:  # fmt: skip
        from fieldpose.deploy.evaluation.page import Evaluation, html
        from fieldpose.deploy.settings import differing

        curves = io.BytesIO()
        self._draw(answers, surface, curves)
        about = [f"looked for with {self.field.name}", *words.about(figures)]
        scores = (words.COLUMNS, list(words.rows(figures["methods"])))
        settings = differing(self.settings)
        return html(Evaluation(str(self.dataset), about, scores, words.gaps(figures), curves.getvalue(), settings),
                    answers, examination)  # fmt: skip

    def _draw(
        self, answers: Mapping[str, Sequence[Answer]], surface: Surface | None, path: Path | IO[bytes]
    ) -> None:  # fmt: skip
        from fieldpose.deploy.evaluation.plots import plot_reach, plot_success

        count = max(len(given) for given in answers.values())
        title = f"{self.field.name}, {self.protocol}, {count} pairs"
        if self.protocol == "reach":
            plot_reach(answers, path, title, None if surface is None else surface.diameter)
        else:
            plot_success(answers, path, title)


def _warn_of_training_images(field: Field, dataset: Dataset) -> None:
    known = {camera.name for camera in field.metadata.cameras} & {record.name for record in dataset.images}
    if known:
        print(f"warning: the field was trained on {len(known)} of these images; these are no held-out figures")


def _scores(answers: Mapping[str, Sequence[Answer]], surface: Surface | None) -> dict[str, Any]:
    from fieldpose.deploy.evaluation.methods import METHODS
    from fieldpose.deploy.evaluation.scores import difference, score, share_of_solvable

    answers = {name: given for name, given in answers.items() if given}
    first, *others = answers
    whole = {name: METHODS[name].ablates or first for name in others}
    than = {name: other if other in answers else first for name, other in whole.items()}
    return {
        "methods": {
            name: {**score(given, surface), "share_of_solvable": share_of_solvable(given, list(answers.values()))}
            for name, given in answers.items()
        },
        "differences": {
            name: {"than": other, **difference(answers[name], answers[other])} for name, other in than.items()
        },
    }
