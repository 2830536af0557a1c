"""How fast a field is learnt: against the plain twin, and how good it is after so many seconds."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.coverage import silhouette_coverage
from fieldpose.deploy.benchmarks.depth import depth_error
from fieldpose.deploy.benchmarks.fields import kept_field
from fieldpose.deploy.benchmarks.memory import peak_mb
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.from_dataset import finished, held_out_views, metadata_of, replace_metadata, views_of
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.torch_training import TorchTrainer
from fieldpose.stages.nerf.training import Learner, Trainer, evaluate

CHECKPOINTS_S = (15, 30, 60, 120, 300)
_VIEWS = 8
_LEARN = """
import sys
from fieldpose.deploy.cli import main
assert main(sys.argv[1:]) == 0
"""


def compare(dataset: Path, size: int, model: FieldConfig, steps: int) -> dict[str, float]:
    """Samples a second of the kernels and of the plain twin, over the same steps from the same start."""
    torch.set_num_threads(machine.cores())
    data = load_dataset(dataset, "train", size)
    views = views_of(data)
    metadata = metadata_of(data, views, model)
    rates = {}
    for name, make in (("samples_per_s", _kernels), ("twin_samples_per_s", _twin)):
        learner = make(views, metadata)
        learner.step(0.0)  # looks at the whole grid, once
        began, before = time.perf_counter(), learner.samples
        for _ in range(steps):
            learner.step(0.0)
        rates[name] = (learner.samples - before) / (time.perf_counter() - began)
    return rates | {"speedup": rates["samples_per_s"] / rates["twin_samples_per_s"]}


def _kernels(views: list[View], metadata: FieldMetadata) -> Learner:
    return Trainer(views, metadata.space, metadata.config, TrainingConfig())


def _twin(views: list[View], metadata: FieldMetadata) -> Learner:
    return TorchTrainer(views, metadata.space, metadata.config, TrainingConfig(), torch.device("cpu"))


@dataclass(frozen=True)
class Course:
    """PSNR in dB and the share of the silhouette that is covered, on held-out views by seconds of training, and the
    error of depth at the end (see silhouette_coverage, depth_error)."""

    psnr_db: dict[str, float]
    coverage: dict[str, float]
    depth_error: dict[str, float] | None


def over_time(
    dataset: Path, size: int, model: FieldConfig, minutes: float, out: Path, report: Callable[[str], None]
) -> Course:
    """Learn, and measure at each of the checkpoints within the time, which takes none of it; the field is kept."""
    data = load_dataset(dataset, "train", size)
    views = views_of(data)
    metadata = metadata_of(data, views, model)
    held_out = held_out_views(dataset, size, "auto")
    some = held_out[:: max(1, len(held_out) // _VIEWS)]
    learner = Trainer(views, metadata.space, metadata.config, TrainingConfig())
    total = 60 * minutes
    checkpoints = [s for s in CHECKPOINTS_S if s < total] + [total]
    test = load_dataset(dataset, "test", size)
    scores: dict[str, float] = {}
    covered: dict[str, float] = {}
    errors = None
    spent = 0.0
    while checkpoints:
        began = time.perf_counter()
        learner.step(min(spent / total, 1.0))
        spent += time.perf_counter() - began
        if spent >= checkpoints[0]:
            seconds = checkpoints.pop(0)
            field = learner.field(metadata) if checkpoints else finished(learner, metadata, views)
            renderer = NumbaRenderer(field, machine.cores())
            scores[f"{seconds:g}"] = float(np.mean(evaluate(renderer, some if checkpoints else held_out)))
            share = silhouette_coverage(renderer, test)
            if share is not None:
                covered[f"{seconds:g}"] = share
            report(f"{dataset.resolve().name}: {scores[f'{seconds:g}']:.2f} dB after {seconds:g} s")
            if not checkpoints:
                errors = depth_error(renderer, test)
                field.metadata = replace_metadata(metadata, psnr_db=scores[f"{seconds:g}"], trained_seconds=spent)
                field.save(kept_field(out, dataset, size, minutes))
            renderer.close()
    return Course(scores, covered, errors)


def _peak_mb(dataset: Path, size: int, model: FieldConfig, steps: int) -> float:
    shape = [argument for name, value in asdict(model).items() for argument in (f"--model.{name}", value)]
    with tempfile.TemporaryDirectory() as folder:
        field = Path(folder) / "field.safetensors"
        training = ("--size", size, "--out", field, "--training.steps", steps)
        return peak_mb(_LEARN, "train", dataset, *training, *shape)


def measure(
    datasets: Sequence[tuple[Path, int]],
    model: FieldConfig,
    minutes: float,
    steps: int,
    memory_steps: int,
    out: Path,
    report: Callable[[str], None],
) -> dict[str, Any]:
    """Everything that `fieldpose bench train` prints, as its JSON.

    The twin takes so many steps on the first dataset; a process of its own, whose memory is looked at, takes
    `memory_steps`; every dataset (its folder, pixels) is learnt for so many minutes and its field kept in `out`.
    """
    report("the plain twin")
    rates = compare(*datasets[0], model, steps)
    report("memory")
    memory = _peak_mb(*datasets[0], model, memory_steps)
    courses = {path.resolve().name: over_time(path, size, model, minutes, out, report) for path, size in datasets}
    return {
        "machine": machine.describe(),
        **rates,
        "rss_mb": memory,
        "psnr_db": {name: course.psnr_db for name, course in courses.items()},
        "silhouette_coverage": {name: course.coverage for name, course in courses.items() if course.coverage},
        "depth_error": {name: course.depth_error for name, course in courses.items() if course.depth_error},
    }


def plot(figures: dict[str, Any], path: Path) -> None:
    """PSNR over time, as a picture."""
    drawing, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, scores in figures["psnr_db"].items():
        axis.semilogx([float(s) for s in scores], list(scores.values()), "o-", label=name)
    seconds = sorted({float(s) for scores in figures["psnr_db"].values() for s in scores})
    axis.set_xticks(seconds, [f"{s:g}" for s in seconds])
    axis.minorticks_off()
    axis.set_xlabel("seconds of training")
    axis.set_ylabel("PSNR on held-out views, dB")
    axis.grid(visible=True, alpha=0.3)
    axis.legend()
    axis.set_title(figures["machine"], fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)
