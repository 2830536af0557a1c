"""From posed photographs to a field."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from fieldpose.deploy.reporting.output import check_writable, progress_console, write_bytes, write_json
from fieldpose.deploy.reporting.overlay import captioned, encoded
from fieldpose.deploy.reporting.turntable import check_video, write_turntable
from fieldpose.deploy.settings import overridden
from fieldpose.errors import OutputError
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig

if TYPE_CHECKING:
    from fieldpose.stages.nerf.field import Field
    from fieldpose.stages.nerf.from_dataset import TrainedField, TrainingReport

_LINE_EVERY_S = 30.0


@dataclass(frozen=True)
class Options:
    """Learn a field from posed photographs, and measure it on the held-out ones.

    Example: fieldpose train ../shared/data/lego --size 400 --minutes 5 --out out/lego.safetensors

    The kind of dataset is recognised from its folder: Blender/NeRF-synthetic, transforms.json (instant-ngp,
    nerfstudio), LLFF, a COLMAP model with its images, a scene of BOP (SCENE/obj_000005 where it has several
    objects), 7-Scenes, TUM RGB-D, or what Polycam and Record3D export. First its cameras are compared with the
    images, and adjusted where they do not fit. From the first fifth of the training on, a picture beside the field
    (.jpg) shows a held-out image and what is learnt of it. Ctrl-C ends the training early and keeps what was
    learnt. In the end some of the training images are looked for in the field, which tells how exact poses are to
    be expected, and whether the dataset's own are in order. The JSON file has: psnr_db (mean over the held-out
    views, null without any), psnr_db_by_view, accuracy (images, found, rotation_deg and translation, medians,
    error_scale, how many times larger errors are than an image shows; null where too few were found), cameras
    (verdict: fit, adjusted, too few or no fit; before_px, after_px, rotation_deg, translation, focal_px, kept; null
    where they were taken as given), steps, seconds, interrupted, size_bytes.
    """

    dataset: tyro.conf.Positional[Path]
    """The folder of the dataset."""
    out: Path
    """The field to write (.safetensors)."""
    size: int | None = 400
    """Shrink images whose longer side has more pixels."""
    minutes: float | None = None
    """Time to train for (short for --training.minutes; 5 by default)."""
    backend: Literal["auto", "numba", "torch", "cuda"] | None = None
    """Compiled kernels on the CPU, torch on it (slow) or on a CUDA device; auto: there, where there is one (short for
    --training.backend)."""
    holdout: Literal["auto", "odd", "every8", "none"] = "auto"
    """Which images of a dataset without splits of its own are held out: auto is odd for transforms.json, every8 for
    others."""
    cameras: Literal["auto", "given"] = "auto"
    """auto: where the images' own matches show that poses, focal length or distortion are off by more than is seen,
    they are adjusted before the training, in the dataset's frame and unit; else they are kept as they are. given: they
    are taken as they are, without looking."""
    only: Literal["box", "masks"] | None = None
    """Learn an object alone, so that it is found wherever it is moved. box: what is in the dataset's object_aabb, which
    `capture` puts around what the cameras look at. masks: what the images' masks show. Without this option what masks
    leave out is not learnt, and everything else is."""
    turntable: str | None = None
    """Write a video (.mp4) of what was learnt, three seconds around the object or along training views, into this file;
    by default beside the field, under its name. none: write none."""
    json: Path | None = None
    """Write the figures into this file."""
    training: TrainingConfig = dataclasses.field(default_factory=TrainingConfig)
    model: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    matching: MatchingConfig = dataclasses.field(default_factory=MatchingConfig)
    """By what the field is tried on its training images in the end; XFeat's weights also serve to remember these."""

    def run(self) -> int:
        """Train, say how good the field is."""
        from fieldpose.deploy.evaluation.accuracy import in_words
        from fieldpose.deploy.learning import learn_field

        turntable = self._turntable()
        check_writable(self.out, self.json)
        check_video(turntable)
        training = overridden(self.training, minutes=self.minutes, backend=self.backend)
        holdout = None if self.holdout == "none" else self.holdout
        began = time.monotonic()
        with _progress_bar(self.out.with_suffix(".jpg")) as (report, looked):
            trained = learn_field(
                self.dataset, self.out, self.size, holdout, training, self.model, self.matching, report, _say,
                self.cameras, _say, looked, self.only,
            )  # fmt: skip
        figures = _figures(trained, self.out)
        write_json(self.json, figures)
        print(f"{self.out}: {_quality(trained)}; {figures['size_bytes'] / 1e6:.1f} MB, ", end="")
        print(f"{figures['steps']} steps in {figures['seconds']:.0f} s, all in {time.monotonic() - began:.0f} s")
        accuracy, unit = trained.field.metadata.accuracy, trained.field.metadata.unit
        if accuracy is not None:
            print(f"from the training view next to it, {in_words(accuracy)} (lengths in: {unit})")
        if turntable is not None:
            _show(trained.field, training.threads, turntable)
        return 0

    def _turntable(self) -> Path | None:
        if self.turntable is None:
            return self.out.with_suffix(".mp4")
        return None if self.turntable == "none" else Path(self.turntable)


def _show(field: Field, threads: int, path: Path) -> None:
    from fieldpose.stages.nerf.renderer import NumbaRenderer

    renderer = NumbaRenderer(field, threads)
    write_turntable(renderer, field.metadata, path)
    renderer.close()
    print(f"{path}: a video of what was learnt")


def _say(text: str) -> None:
    progress_console().print(text, soft_wrap=True)


def _figures(trained: TrainedField, out: Path) -> dict[str, Any]:
    scores = trained.test_psnr_db
    return {
        "psnr_db": float(np.mean(scores)) if scores else None,
        "psnr_db_by_view": scores,
        "accuracy": msgspec.to_builtins(trained.field.metadata.accuracy),
        "cameras": msgspec.to_builtins(trained.field.metadata.camera_fit),
        "steps": trained.field.metadata.trained_steps,
        "seconds": trained.field.metadata.trained_seconds,
        "interrupted": trained.interrupted,
        "size_bytes": out.stat().st_size,
    }


def _quality(trained: TrainedField) -> str:
    if trained.interrupted:
        return "ended early, not measured"
    scores = trained.test_psnr_db
    return f"{np.mean(scores):.2f} dB on {len(scores)} held-out views" if scores else "no held-out views"


@contextmanager
def _progress_bar(
    preview: Path,
) -> Iterator[tuple[Callable[[TrainingReport], None], Callable[[str, float], None]]]:
    """Gives functions that show on stderr, as lines where that is no terminal, a training and what comes before it.

    preview: where a picture of what is learnt is written whenever there is a new one.
    """
    console = progress_console()
    columns = (TextColumn("{task.fields[doing]}"), BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("reading the images", total=1.0, doing="training")
        next_line, last = 0.0, ""

        def looked(what: str, share: float) -> None:
            nonlocal last
            bar.update(task, completed=share, description=what, doing="cameras")
            if not console.is_terminal and what != last:
                console.print(f"cameras: {what}", highlight=False)
            last = what

        def report(state: TrainingReport) -> None:
            nonlocal next_line
            text = _step_in_words(state)
            if state.preview is not None:
                _write_preview(state.preview, state.progress.seconds, preview)
            bar.update(task, completed=state.progress.fraction, description=text, doing="training")
            if not console.is_terminal and state.progress.seconds >= next_line:
                next_line = state.progress.seconds + _LINE_EVERY_S
                console.print(f"training: {state.progress.fraction:.0%}, {text}", highlight=False)

        yield report, looked


def _write_preview(beside: np.ndarray, seconds: float, path: Path) -> None:
    picture = captioned(beside, [f"held-out image, and as learnt after {seconds:.0f} s"])
    try:
        write_bytes(path, encoded(picture, path))
    except OutputError as error:
        # No reason to lose what is learnt.
        _say(f"no picture of what is learnt: {error}")


def _step_in_words(state: TrainingReport) -> str:
    progress = state.progress
    loss = 10 ** (-progress.train_psnr_db / 10)
    held_out = "" if state.validation_psnr_db is None else f", held-out views {state.validation_psnr_db:.2f} dB"
    return f"step {progress.step}, loss {loss:.5f} ({progress.train_psnr_db:.2f} dB){held_out}"
