"""How fast the parts are on this machine."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.benchmarks.isa import Isa, limited_to
from fieldpose.deploy.commands.bench_chaos import Chaos
from fieldpose.deploy.commands.bench_endure import Endure
from fieldpose.deploy.commands.bench_fuzz import Fuzz
from fieldpose.deploy.commands.bench_mesh import Mesh
from fieldpose.deploy.commands.bench_record import Record
from fieldpose.deploy.commands.bench_scale import Scale
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import UsageError
from fieldpose.stages.nerf.config import FieldConfig

_LEAST_BYTES = 8
_DATA = Path("..") / "shared" / "data"
_SIZES = {"lego": 400, "demo": 400, "fern": 504, "fox": 480}


@dataclass(frozen=True)
class Render:
    """A view at several sizes: time, samples, loss against an exhaustive render, share of what the machine can do.

    Example: fieldpose bench render --json out/bench/render.json

    The JSON file has: machine, isa, field, limits, rss_mb, sizes (pixels of the longer side -> ms_per_view,
    twin_ms_per_view, speedup, psnr_loss_db, samples, samples_per_s, fraction_of_limit and more), steps, tables, rays.
    """

    dataset: Path | None = None
    """Posed images with a held-out split; ../shared/data/lego where it exists, else the demo scene."""
    field: Path | None = None
    """A field of them; one is trained and kept in the output folder where none is given."""
    sizes: tuple[int, ...] = (200, 320, 400, 800)
    """Pixels of the longer side."""
    views: int = 3
    """Views of each size; one of those above 400 pixels, since the twin takes a minute there."""
    minutes: float = 5.0
    """Time to train for."""
    isa: Isa = "native"
    """Instructions that may be used: avx2 holds a machine that has AVX-512 to what older ones have."""
    out: Path = Path("out/bench")
    """Folder of the field and of the plot, render.png."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print, plot."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import render

        dataset = self.dataset or _first_dataset()
        with progress_console().status("training the field") as status:
            path = render.field_of(self.field, dataset, 400, self.minutes, self.out)
            report = _into(status.update, "bench render")
            figures = limited_to(self.isa, render.measure, path, dataset, self.sizes, self.views, report)
        render.plot(figures, self.out / "render.png")
        write_json(self.json, figures)
        tables.print_render(figures)
        print(f"written: {self.out / 'render.png'}")
        return 0


@dataclass(frozen=True)
class Train:
    """Training: samples a second against the plain twin, and the quality on held-out views over time.

    Example: fieldpose bench train --json out/bench/train.json

    The JSON file has: machine, samples_per_s, twin_samples_per_s, speedup, rss_mb, psnr_db (dataset -> seconds -> dB),
    silhouette_coverage (dataset with known outlines -> seconds -> share of the object's pixels that the field shows),
    depth_error (dataset with true depth -> median, p90: shares of the depth, within the object).
    """

    datasets: tuple[Path, ...] = ()
    """Posed images; by default lego, fern and fox in ../shared/data, where they exist, and the demo scene."""
    minutes: float = 5.0
    """Time to train for on each."""
    twin_steps: int = 60
    """Training steps over which the two are compared."""
    memory_steps: int = 300
    """Training steps after which the highest memory is read."""
    out: Path = Path("out/bench")
    """Folder of the fields and of the plot, train.png."""
    json: Path | None = None
    model: FieldConfig = dataclasses.field(default_factory=FieldConfig)

    def run(self) -> int:
        """Measure, print, plot."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import train

        datasets = [(path, _SIZES.get(path.resolve().name, 400)) for path in self.datasets or _all_datasets()]
        with progress_console().status("bench train") as status:
            report = _into(status.update, "bench train")
            figures = train.measure(
                datasets, self.model, self.minutes, self.twin_steps, self.memory_steps, self.out, report
            )
        train.plot(figures, self.out / "train.png")
        write_json(self.json, figures)
        tables.print_train(figures)
        print(f"written: {self.out / 'train.png'}")
        return 0


@dataclass(frozen=True)
class Match:
    """Matchers: time of a pair of images, number of matches, share that are right, on views of the demo scene.

    Example: fieldpose bench match --json out/bench/match.json

    Test images are matched with views from poses up to 15 degrees off. A match is right within 2 pixels of where the
    view's depth and the image's known pose place it. Matchers without weights on this machine are left out. The JSON
    file has: machine, threads, pairs, right_px, missing (matcher -> why), sizes (pixels -> matcher -> ms_per_pair,
    ms_view_known (the view's features kept), matches (a pair's, in the mean), share_right).
    """

    matchers: tuple[str, ...] = ()
    """By default all of them."""
    sizes: tuple[int, ...] = (256, 400)
    """Pixels of the longer side, of the view and the image alike."""
    pairs: int = 10
    """Pairs of each size."""
    threads: int = 0
    """Threads of the networks; 0 takes all cores. Beside other work, more than are free take many times as long."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import match

        with progress_console().status("bench match") as status:
            report = _into(status.update, "bench match")
            figures = match.measure(self.matchers, self.sizes, self.pairs, self.threads, report)
        write_json(self.json, figures)
        tables.print_match(figures)
        return 0


@dataclass(frozen=True)
class Bus:
    """The bus between two processes: delay, throughput, loss; and what a frame costs as JPEG bytes and as pixels.

    Example: fieldpose bench bus --json out/bench/bus.json

    A frame is sent as a JPEG file that each of three processes decodes, and as pixels that the camera's process has
    decoded; counted is the CPU time of all processes. The JSON file has: machine, payloads (bytes -> one_way_ms and
    round_trip_ms (p50, p90, p99), lost (share), messages_per_s, mb_per_s, lost_in_flow, encode_ms and decode_ms of a
    Frame of that size), receivers, jpeg_quality, frames (size -> jpeg_bytes, rgb8_bytes, decode_jpeg_ms_cpu, and of
    both jpeg and rgb8: _ms_cpu, of which _ms_cpu_sender and, of one receiver, _ms_cpu_receiver; _ms_to_pixels).
    """

    payloads: tuple[int, ...] = (1 << 10, 1 << 16, 480 * 360 * 3, 1280 * 720 * 3)
    """Bytes of a message."""
    trips: int = 200
    """Messages of each size, there and back."""
    flow_mb: float = 200.0
    """Megabytes of each size, at most 2000 messages, as fast as they go."""
    sizes: tuple[str, ...] = ("480x360", "640x480", "1280x720")
    """Of frames, in pixels."""
    frames: int = 120
    """Frames of each size, at 60 a second."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        sizes = [_size(text) for text in self.sizes]
        if min(self.payloads, default=0) < _LEAST_BYTES or min(self.trips, self.frames) < 1 or not self.flow_mb > 0:
            raise UsageError(
                f"bench bus: payloads of at least {_LEAST_BYTES} bytes, and at least one of each, are needed"
            )
        from fieldpose.deploy.benchmarks import bus

        # No display that moves: what it takes would be counted as the sender's.
        report = _into(progress_console().print, "bench bus")
        figures = bus.measure(self.payloads, self.trips, self.flow_mb, sizes, self.frames, report)
        write_json(self.json, figures)
        tables.print_bus(figures)
        return 0


@dataclass(frozen=True)
class Track:
    """Following a camera live, as whoever uses the poses meets it: sequences at their own pace, by the real processes.

    Example: fieldpose bench track --json out/bench/track.json

    The JSON file has: machine, sequences (name -> cores -> number of cores -> share_of_frames, poses_per_s,
    latency_ms, rotation_error_deg, translation_error, wrong_while_tracking, first_pose_s, ready_s, pss_mb, jitter and
    more, which stand in deploy/benchmarks/followed.py; with the most cores also steps -> number -> share_right, of
    all frames sent), ablations (name -> the same as under sequences, with the most cores), plain_loop_rate_hz (frames
    a second in one process, of the first sequence, with all work done on each).
    """

    sequences: tuple[str, ...] = ("demo", "kitchen")
    """demo, kitchen (left out where ../shared/data/kitchen is not there), or recordings (.mcap) with true poses."""
    field: Path | None = None
    """The field of the recordings."""
    kitchen_field: Path | None = None
    """A field of ../shared/data/kitchen; one is trained and kept in the output folder where none is given."""
    minutes: float = 5.0
    """Time to train that for."""
    cores: tuple[int, ...] = (2, 1)
    """The whole pipeline is held to so many; those that this machine does not have are left out."""
    steps: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    """Only every so many-th frame is sent, at its own time."""
    ablations: tuple[str, ...] = ()
    """Changes of settings to measure besides, by default all. default: none; full: every frame has all its passes, each
    of them refined, from views of 400 pixels."""
    frames: int | None = None
    """Only so many, from the start of each sequence (default: all)."""
    out: Path = Path("out/bench")
    """Folder of the pictures, one of each run over time, and of the kitchen's field."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import sequences, track

        ablations = self.ablations or tuple(track.ABLATIONS)
        wanted = track.Wanted(self.cores, self.steps, ablations, self.out, self.frames)
        fields = sequences.Fields(_DATA / "kitchen", self.out, self.minutes, self.kitchen_field, self.field)
        # No display that moves: it would take time from the processes.
        report = _into(progress_console().print, "bench track")
        figures = track.measure(sequences.found(self.sequences, fields, report), wanted, report)
        write_json(self.json, figures)
        tables.print_track(figures)
        print(f"each run over time: {self.out / 'track-*.png'}")
        return 0


@dataclass(frozen=True)
class Start:
    """How a pipeline begins by itself: started anew at each of several views, without a guess, until its first answer.

    Example: fieldpose bench start out/lego.safetensors --source dataset:../shared/data/lego:test

    A photo is shown as a camera that stands still would see it, a video from one of its frames on. The JSON file has:
    machine, field, source, views, share_right, share_answered, share_in_time, first_pose_s (p50, p90, max), ready_s,
    not_right (of each such view what came first), which stand in deploy/benchmarks/start.py.
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors) of the object or scene."""
    source: str
    """dataset:DIR:test, or a recording with true poses, mcap:FILE."""
    views: int = 25
    """Spread over the source."""
    seconds: float = 2.0
    """How long each may take to answer."""
    cores: int | None = None
    """Hold the whole pipeline to so many (default: all)."""
    json: Path | None = None

    def run(self) -> int:
        """Measure, print."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks import machine, start

        if self.views < 1 or not self.seconds > 0 or not 1 <= (self.cores or 1) <= machine.cores():
            raise UsageError(
                f"bench start: views and seconds must be above 0, and cores from 1 to {machine.cores()}, got"
                f" {self.views}, {self.seconds:g} and {self.cores}"
            )
        report = _into(progress_console().print, "bench start")
        figures = start.measure(self.field, self.source, self.views, self.seconds, self.cores, report)
        write_json(self.json, figures)
        tables.print_start(figures)
        return 0


@dataclass(frozen=True)
class Options:
    """Measure how fast the parts are on this machine, or (fuzz) what they can bear; run it while nothing else runs.

    Example: fieldpose bench render
    """

    what: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Match, tyro.conf.subcommand("match")]
        | Annotated[Bus, tyro.conf.subcommand("bus")]
        | Annotated[Record, tyro.conf.subcommand("record")]
        | Annotated[Scale, tyro.conf.subcommand("scale")]
        | Annotated[Track, tyro.conf.subcommand("track")]
        | Annotated[Start, tyro.conf.subcommand("start")]
        | Annotated[Mesh, tyro.conf.subcommand("mesh")]
        | Annotated[Chaos, tyro.conf.subcommand("chaos")]
        | Annotated[Fuzz, tyro.conf.subcommand("fuzz")]
        | Annotated[Endure, tyro.conf.subcommand("endure")]
    ]

    def run(self) -> int:
        """Run the benchmark that was asked for."""
        return self.what.run()


def _all_datasets() -> list[Path]:
    found = {name: _DATA / name for name in ("lego", "fern", "fox") if (_DATA / name).is_dir()}
    return [*found.values(), demo_file("transforms_train.json").parent]


def _first_dataset() -> Path:
    return _all_datasets()[0]


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if found is None:
        raise UsageError(f"bench bus: {text!r} is no size; expected for instance 640x480")
    return int(found[1]), int(found[2])


def _into(update: Callable[[str], None], title: str) -> Callable[[str], None]:
    return lambda text: update(f"{title}: {text}")
