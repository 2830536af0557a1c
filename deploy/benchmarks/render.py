"""How fast a view is rendered: against the plain twin, against the machine, and as it grows."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import msgspec
import numpy as np
import torch

from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.fields import kept_field
from fieldpose.deploy.benchmarks.isa import instruction_set
from fieldpose.deploy.benchmarks.memory import peak_mb
from fieldpose.stages.geometry.cameras import rays
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import TrainingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.framing import in_dataset_frame
from fieldpose.stages.nerf.from_dataset import replace_metadata, train_field, views_of
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView
from fieldpose.stages.nerf.torch_renderer import TorchRenderer
from fieldpose.stages.nerf.training import colours, psnr

_FINER = 4
_LOOK = """
import sys
from pathlib import Path
from fieldpose.stages.nerf.loading import load_renderer
from fieldpose.stages.geometry.cameras import rays
from fieldpose.stages.nerf.datasets import load_dataset
renderer = load_renderer(Path(sys.argv[1]))
for record in load_dataset(Path(sys.argv[2]), "test", int(sys.argv[3])).images[:3]:
    renderer.render_view(record.camera.undistorted(), record.cam_from_object)
"""


@dataclass(frozen=True)
class Timed:
    """A view and the seconds that it took."""

    view: RenderedView
    seconds: float


def field_of(path: Path | None, dataset: Path, size: int, minutes: float, folder: Path) -> Path:
    """The field to measure: the one given, else one trained on the dataset and kept in the folder."""
    if path is not None:
        return path
    path = kept_field(folder, dataset, size, minutes)
    if not path.is_file():
        train_field(dataset, path, size, training=TrainingConfig(minutes=minutes))
    return path


def measure(
    path: Path, dataset: Path, sizes: Sequence[int], views: int, report: Callable[[str], None]
) -> dict[str, Any]:
    """Everything that `fieldpose bench render` prints, as its JSON."""
    field = load_field(path)
    field.metadata = in_dataset_frame(field.metadata)
    torch.set_num_threads(machine.cores())
    report("measuring the machine")
    limit = machine.limits(field.metadata.config, len(field.net.table))
    by_size = {}
    for size in sizes:
        report(f"{size} pixels")
        by_size[str(size)] = _at_size(field, limit, _views(dataset, size, views if size <= 400 else 1))
    report("longer rays, larger tables, memory")
    view = _views(dataset, 400, 1)[0]
    return {
        "machine": machine.describe(),
        "isa": instruction_set(),
        "field": {"file": path.name, "psnr_db": field.metadata.psnr_db, "mb": path.stat().st_size / 1e6},
        "limits": dataclasses.asdict(limit),
        "sizes": by_size,
        "rays": _rays(field, _views(dataset, 400, 3)),
        "steps": _by_step(field, view),
        "tables": _by_table(field, view),
        "rss_mb": peak_mb(_LOOK, path, dataset, 400),
    }


def _views(dataset: Path, size: int, count: int) -> list[View]:
    held_out = load_dataset(dataset, "test", size)
    places = np.linspace(0, len(held_out.images) - 1, count).round().astype(int)
    return views_of(dataclasses.replace(held_out, images=tuple(held_out.images[i] for i in places)))


def _at_size(field: Field, limit: machine.Limits, views: list[View]) -> dict[str, float]:
    fast, twin = NumbaRenderer(field, machine.cores()), TorchRenderer(field)
    exhaustive = NumbaRenderer(_with_step(field, 1 / _FINER), machine.cores(), stop_below=0.0)
    _timed(fast, views[0])
    rows = []
    for view in views:
        slow = _timed(twin, view)
        fast.samples_evaluated = 0
        quick = [_timed(fast, view) for _ in range(5)]
        rows.append(
            {
                "ms_per_view": 1e3 * float(np.median([q.seconds for q in quick])),
                "twin_ms_per_view": 1e3 * slow.seconds,
                "samples": fast.samples_evaluated / len(quick),
                "rays_that_meet_any": float(np.count_nonzero(quick[0].view.opacity)),
                "psnr_db": _psnr(quick[0].view, view, field),
                "twin_psnr_db": _psnr(slow.view, view, field),
                "exhaustive_psnr_db": _psnr(_timed(exhaustive, view).view, view, field),
            }
        )
    fast.close()
    exhaustive.close()
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    camera = views[0].camera
    least = limit.seconds(field.metadata.config, int(mean["samples"]), int(mean["rays_that_meet_any"]))
    return mean | {
        "views": len(views),
        "pixels": camera.width * camera.height,
        "speedup": mean["twin_ms_per_view"] / mean["ms_per_view"],
        "psnr_loss_db": mean["exhaustive_psnr_db"] - mean["psnr_db"],
        "samples_per_s": 1e3 * mean["samples"] / mean["ms_per_view"],
        "fraction_of_limit": 1e3 * least / mean["ms_per_view"],
    }


def _timed(renderer: RayRenderer, view: View) -> Timed:
    began = time.perf_counter()
    rendered = renderer.render_view(view.camera.undistorted(), view.cam_from_object)
    return Timed(rendered, time.perf_counter() - began)


def _psnr(rendered: RenderedView, view: View, field: Field) -> float:
    return psnr(float(np.mean((rendered.rgb / 255 - colours(view, field.metadata)) ** 2)))


def _with_step(field: Field, factor: float) -> Field:
    space = field.metadata.space
    metadata = replace_metadata(field.metadata, space=msgspec.structs.replace(space, step=space.step * factor))
    return Field(metadata, field.net, field.occupied)


def _with_tables(net: Net, factor: int) -> Net:
    """The same field in tables `factor` times as large: each hashed level is repeated, its values stay."""
    parts, offsets, at = [], [], 0
    for offset, resolution, mask in zip(net.offsets, net.resolutions, net.masks, strict=True):
        size = int((resolution + 1) ** 3 if mask < 0 else mask + 1)
        parts.append(np.tile(net.table[offset : offset + size], (1 if mask < 0 else factor, 1)))
        offsets.append(at)
        at += len(parts[-1])
    masks = np.where(net.masks < 0, net.masks, (net.masks + 1) * factor - 1)
    return net._replace(table=np.concatenate(parts), offsets=np.array(offsets, np.int64), masks=masks)


def _median_ms(field: Field, view: View) -> tuple[float, float]:
    """Milliseconds of a view, and its samples."""
    renderer = NumbaRenderer(field, machine.cores())
    _timed(renderer, view)
    renderer.samples_evaluated = 0
    times = [_timed(renderer, view).seconds for _ in range(5)]
    renderer.close()
    return 1e3 * float(np.median(times)), renderer.samples_evaluated / len(times)


def _rays(field: Field, views: list[View]) -> dict[str, float]:
    """Thousands of rays through surfaces in several views, in no order, and rays as refinement asks for them."""
    rng = np.random.default_rng(0)
    renderer = NumbaRenderer(field, machine.cores())
    pixels = [v.camera.grid()[rng.permutation(v.camera.width * v.camera.height)] for v in views]
    bundles = [rays(v.camera, v.cam_from_object, p[:12000]) for v, p in zip(views, pixels, strict=True)]
    solid = [renderer.render_rays(o, d).opacity > 0.5 for o, d in bundles]
    origins = np.concatenate([o[s][:1365] for (o, _), s in zip(bundles, solid, strict=True)])
    directions = np.concatenate([d[s][:1365] for (_, d), s in zip(bundles, solid, strict=True)])
    renderer.samples_evaluated = 0
    began = time.perf_counter()
    for _ in range(10):
        renderer.render_rays(origins, directions)
    rate = renderer.samples_evaluated / (time.perf_counter() - began)
    grey = np.full((1, 3), 1 / 3, np.float32)
    renderer.render_rays_jacobian(origins[:8], directions[:8], grey)
    began = time.perf_counter()
    for i in range(40):
        part = slice(512 * (i % 2), 512 * (i % 2) + 512)
        renderer.render_rays_jacobian(origins[part], directions[part], grey)
    refinement = time.perf_counter() - began
    two = 2 * float(np.median([_timed(renderer, views[0]).seconds for _ in range(5)]))
    renderer.close()
    return {
        "scattered": len(origins),
        "scattered_samples_per_s": rate,
        "refinement_ms": 1e3 * refinement,
        "two_views_ms": 1e3 * two,
    }


def _by_step(field: Field, view: View) -> list[dict[str, float]]:
    pixels = view.camera.width * view.camera.height
    rows = []
    for factor in (2.0, 1.0, 0.5, 0.25, 0.125):
        ms, samples = _median_ms(_with_step(field, factor), view)
        rows.append({"step": factor, "samples_per_ray": samples / pixels, "ms_per_view": ms})
    return rows


def _by_table(field: Field, view: View) -> list[dict[str, float]]:
    rows = []
    for factor in (1, 2, 4, 8, 16):
        larger = Field(field.metadata, _with_tables(field.net, factor), field.occupied)
        ms, _ = _median_ms(larger, view)
        rows.append({"entries": len(larger.net.table), "mb": larger.net.table.size * 2 / 1e6, "ms_per_view": ms})
    return rows


def plot(figures: dict[str, Any], path: Path) -> None:
    """Time of a view by pixels, by samples along a ray and by size of the tables, as a picture."""
    sizes = list(figures["sizes"].values())
    series = (
        ("thousand pixels", [s["pixels"] / 1000 for s in sizes], [s["ms_per_view"] for s in sizes]),
        ("samples along a ray (400 pixels)", *_columns(figures["steps"], "samples_per_ray")),
        ("tables, MB (400 pixels)", *_columns(figures["tables"], "mb")),
    )
    drawing, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for axis, (label, x, y) in zip(axes, series, strict=True):
        axis.plot(x, y, "o-")
        axis.set_xlim(left=0)
        axis.set_ylim(0, 1.1 * max(y))
        axis.set_xlabel(label)
        axis.set_ylabel("ms a view")
        axis.grid(visible=True, alpha=0.3)
    drawing.suptitle(f"Rendering, {figures['machine']}", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)


def _columns(rows: list[dict[str, float]], name: str) -> tuple[list[float], list[float]]:
    return [row[name] for row in rows], [row["ms_per_view"] for row in rows]
