"""The benchmark of meshes: options and run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.deploy.scene import demo_file


@dataclass(frozen=True)
class Mesh:
    """Meshes of a field against the true surface: from fused depth, and where a step is so opaque.

    Example: fieldpose bench mesh --json out/bench/mesh.json

    The JSON file has: machine, field, resolution, ways (name -> seconds, triangles, and of all and of the dataset's
    object: median and p90 (distance of mesh points that test views would see to the true surface, in object units),
    complete (share of the true surface with mesh nearer than `near`)).
    """

    dataset: Path | None = None
    """Posed images whose test views have true depth, and are in a box; the demo scene where none is given."""
    field: Path | None = None
    """A field of them; the demo's own where none is given."""
    resolution: int = 384
    """Cells along the longest side."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import mesh

        dataset = self.dataset or demo_file("transforms_train.json").parent
        with progress_console().status("bench mesh") as status:
            report = lambda text: status.update(f"bench mesh: {text}")  # noqa: E731
            figures = mesh.measure(self.field or demo_file("field.safetensors"), dataset, self.resolution, report)
        write_json(self.json, figures)
        tables.print_mesh(figures)
        return 0
