"""The recorder's benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.errors import UsageError


@dataclass(frozen=True)
class Record:
    """The recorder under a full load: every topic at the camera's rate, with raw images and rendered depth, from
    another process over the bus. Are there messages that it loses, does its memory grow, what does it take?

    Example: fieldpose bench record --json out/bench/record.json

    Parts of the recording are counted and removed once they are finished. The JSON file has: machine, seconds, behind_s
    (the most that the sender was late), sent and written (messages), lost (their difference), lost_by_topic,
    missing_by_sequence and unwritten (by the recorder's own account), parts, mb_per_s, cpu_share (of one
    core), rss_mb (before, highest, after_a_tenth of the time, end).
    """

    seconds: float = 600.0
    """How long."""
    rate: float = 30.0
    """Frames a second."""
    width: int = 640
    """Of frames and views, in pixels."""
    height: int = 480
    """Of frames and views, in pixels."""
    split: str = "1GB"
    """How large parts are; the disk needs room for some of them."""
    out: Path = Path("out/bench")
    """Folder to record in."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        RecordingOptions(split=self.split).parts()
        if not self.seconds > 0 or not 0 < self.rate <= 1000 or not 1 <= min(self.width, self.height) <= 4096:
            raise UsageError("bench record: seconds, rate (at most 1000) and sizes must be above 0")
        from fieldpose.deploy.benchmarks import recording

        with progress_console().status("bench record") as status:
            figures = recording.measure(
                self.seconds, self.rate, (self.width, self.height), self.split, self.out,
                lambda text: status.update(f"bench record: {text}"),
            )  # fmt: skip
        write_json(self.json, figures)
        tables.print_record(figures)
        return 0
