"""How well poses are found on a dataset, method by method over the same pairs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.progress import track
from rich.table import Table

from deploy.errors import UsageError
from deploy.output import check_writable, progress_console, result_console, write_json
from deploy.settings import Settings

if TYPE_CHECKING:
    from deploy.evaluation.pairs import Pair
    from deploy.evaluation.scores import Answer
    from stages.nerf.datasets import Dataset
    from stages.nerf.rendering_api import RayRenderer


@dataclass(frozen=True)
class Options:
    """Draw guesses near the true poses of held-out images, as the published evaluations do, and score the answers.

    Example: fieldpose evaluate out/lego.safetensors ../shared/data/lego --method one-step --method full

    nerf-synthetic: 5 images, 5 guesses each, turned by 10 to 40 degrees about the origin and shifted by up to 0.2;
    llff: up to 40 degrees and 0.1. The same seed gives the same pairs for every method. The JSON file has: protocol,
    pairs, seeds, methods (name -> share_re_below_5deg, share_te_below_0.05, share_both_below, share_ok,
    share_ok_right, mean_re_deg, median_re_deg, p90_re_deg, mean_te, median_te, p90_te, seconds_per_image, covariance),
    differences (name -> mean and 95 % interval of how much larger its errors are than the first method's).
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors)."""
    dataset: tyro.conf.Positional[Path]
    """The dataset; its held-out images are used."""
    protocol: Literal["nerf-synthetic", "llff"] = "nerf-synthetic"
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """one-step, one-step-unmined, passes, full or full-anywhere; may be given several times, all by default."""
    seeds: tuple[int, ...] = (0, 1, 2, 3)
    images: int = 5
    """Held-out images a seed."""
    poses: int = 5
    """Guesses an image."""
    size: int = 400
    """Shrink images whose longer side has more pixels."""
    json: Path | None = None
    """Write the scores into this file."""
    plot: Path | None = None
    """Write success curves into this file (.png)."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Evaluate, print the table."""
        from deploy.evaluation import pairs
        from deploy.evaluation.methods import METHODS
        from deploy.evaluation.scores import difference, score
        from stages.nerf.datasets import load_dataset
        from stages.nerf.field import load_field
        from stages.nerf.loading import make_renderer
        from stages.tracking.views import training_views

        check_writable(self.json, self.plot)
        names = self.method or tuple(METHODS)
        unknown = [name for name in names if name not in METHODS]
        if unknown:
            raise UsageError(f"method {unknown[0]!r}: expected one of {', '.join(METHODS)}")
        field = load_field(self.field)
        dataset = load_dataset(self.dataset, "test", self.size)
        truths = [record.cam_from_object for record in dataset.images]
        protocol = dataclasses.replace(pairs.PROTOCOLS[self.protocol], images=self.images, poses=self.poses)
        drawn = pairs.draw(protocol, truths, self.seeds)
        renderer, scale = make_renderer(field, threads=0), training_views(field.metadata).scale
        answers = {name: list(self._answers(name, renderer, scale, dataset, drawn)) for name in names}
        scores = {name: score(given) for name, given in answers.items()}
        first = names[0]
        figures = {
            "protocol": dataclasses.asdict(protocol),
            "unit": dataset.unit,
            "pairs": len(drawn),
            "seeds": list(self.seeds),
            "methods": scores,
            "differences": {name: difference(answers[name], answers[first]) for name in names[1:]},
        }
        write_json(self.json, figures)
        if self.plot is not None:
            from deploy.evaluation.plots import plot_success

            plot_success(answers, self.plot, f"{self.field.name}, {len(drawn)} pairs, {self.protocol}")
        _print(figures)
        return 0

    def _answers(
        self, name: str, renderer: RayRenderer, scale: float, dataset: Dataset, drawn: Sequence[Pair]
    ) -> Iterator[Answer]:
        """A method's answers, each from a fresh start."""
        from deploy.evaluation.methods import METHODS
        from deploy.evaluation.scores import Answer
        from deploy.single import PoseFinder

        settings = METHODS[name](self.settings)
        # Guesses are independent of each other: no view rendered for one may serve the next.
        settings = dataclasses.replace(
            settings, rendering=dataclasses.replace(settings.rendering, reuse_angle_deg=0.0)
        )
        finder = PoseFinder(renderer, settings, scale)
        images = {pair.image: dataset.load_rgb(pair.image) for pair in drawn}
        finder.find(images[drawn[0].image], dataset.images[drawn[0].image].camera, drawn[0].guess)
        for pair in track(drawn, description=name, console=progress_console()):
            began = time.perf_counter()
            found = finder.find(images[pair.image], dataset.images[pair.image].camera, pair.guess)
            yield Answer(pair, found.cam_from_object, found.covariance, time.perf_counter() - began)


def _print(figures: dict[str, Any]) -> None:
    console = result_console()
    console.print(
        f"{figures['pairs']} pairs (seeds {', '.join(map(str, figures['seeds']))}), lengths in: {figures['unit']}",
        highlight=False,
    )
    table = Table()
    columns = ("method", "< 5 deg", "< 0.05", "ok", "ok and right", "RE mean", "median", "TE mean", "median", "s")
    for column in columns:
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, row in figures["methods"].items():
        shares = ("share_re_below_5deg", "share_te_below_0.05", "share_ok", "share_ok_right")
        errors = (("mean_re_deg", 3), ("median_re_deg", 3), ("mean_te", 5), ("median_te", 5))
        table.add_row(
            name,
            *(_number(row[share], 3) for share in shares),
            *(_number(row[error], digits) for error, digits in errors),
            f"{row['seconds_per_image']:.2f}",
        )
    console.print(table)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
