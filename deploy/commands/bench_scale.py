"""The benchmark of many cameras."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import UsageError


@dataclass(frozen=True)
class Scale:
    """What the bus carries when cameras become more: the processes of a run, one for each camera where a run has that,
    over real links, each sending what was recorded of it instead of working it out.

    Example: fieldpose bench scale --json out/bench/scale.json

    The JSON file has: machine, load_before (of the last minute), seconds, topics (of one camera -> per_s, bytes_per_s,
    readers), cameras (their number -> processes, links, mb_per_s_sent, mb_per_s_delivered, published, received, gaps,
    skipped, age_ms (of messages when they are read, of the process where that is highest at 99 %), behind_ms, cpu
    (cores by process), hub_cpu, hub_rss_mb).
    """

    cameras: tuple[int, ...] = (1, 2, 4, 8)
    """How many."""
    seconds: float = 8.0
    """How long each is measured."""
    recording: Path | None = None
    """A recording of a run with one camera (default: the demo is run and recorded)."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        if not 0 < self.seconds <= 600 or not all(1 <= count <= 64 for count in self.cameras):
            raise UsageError("bench scale: expected at most 600 seconds and 1 to 64 cameras")
        from fieldpose.deploy.benchmarks import scale

        with progress_console().status("bench scale") as status, tempfile.TemporaryDirectory() as folder:
            recording = self.recording or _recorded(Path(folder) / "run.mcap")
            figures = scale.measure(
                recording, self.cameras, self.seconds, lambda text: status.update(f"bench scale: {text}")
            )
        write_json(self.json, figures)
        tables.print_scale(figures)
        return 0


def _recorded(path: Path) -> Path:
    """The demo, run and recorded."""
    from fieldpose.deploy.commands.run import planned
    from fieldpose.deploy.processes.pipeline import run_pipeline
    from fieldpose.deploy.settings import Settings

    settings = Settings()
    camera = replace(settings.camera, source=f"mcap:{demo_file('sequence.mcap')}")
    run_pipeline(planned(replace(settings, camera=camera), demo_file("field.safetensors")), record=path)
    return path
