"""How long messages take between two processes of this host, and whether frames are better sent decoded."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from fieldpose.bus.codec import decode, encode
from fieldpose.bus.messages import Frame
from fieldpose.bus.node import first_header
from fieldpose.bus.topics import FRAME, VIEW
from fieldpose.bus.transport import Bus
from fieldpose.deploy.benchmarks import echo, machine
from fieldpose.deploy.benchmarks.other_end import FLOW, FRAMES, OtherEnd, decoded, other_process
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset

RECEIVERS = 3
JPEG_QUALITY = 90
_FRAMES_HZ = 60.0
_MOST_IN_FLOW = 2000
# The first large ones set up shared memory.
_FIRST = 3
_TIMES = 30
_PERCENTILES = (50, 90, 99)

Encoding = Literal["jpeg", "rgb8"]


@dataclass(frozen=True)
class Link:
    """A session, who answers it, and what the process there has received."""

    bus: Bus
    echo: echo.Echo
    other: OtherEnd


def measure(
    payloads: Sequence[int], trips: int, flow_mb: float, sizes: Sequence[tuple[int, int]], frames: int,
    report: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    """Everything that `fieldpose bench bus` prints, as its JSON.

    Payloads are sizes in bytes, each sent there and back so many trips, then flow_mb of them as fast as they go; sizes
    are of images, (width, height), of which so many frames are sent. Raises TransportError.
    """
    with echo.hub() as hub, other_process(hub), echo.session(hub) as bus:
        other = OtherEnd(bus)
        link = Link(bus, echo.Echo(bus), other)
        by_bytes = {}
        for size in payloads:
            report(f"{size} bytes")
            by_bytes[str(size)] = _round_trips(link, size, trips) | _flow(link, size, flow_mb) | _codec_ms(size)
        by_size = {}
        for width, height in sizes:
            report(f"frames of {width}x{height}")
            by_size[f"{width}x{height}"] = _frames(link, width, height, frames)
    return {
        "machine": machine.describe(),
        "payloads": by_bytes,
        "receivers": RECEIVERS,
        "jpeg_quality": JPEG_QUALITY,
        "frames": by_size,
    }


def _round_trips(link: Link, size: int, count: int) -> dict[str, Any]:
    for _ in range(_FIRST):
        link.echo.round_trip_ms(size)
    link.other.received(0)
    link.echo.sent_ns.clear()
    trips = [link.echo.round_trip_ms(size) for _ in range(count)]
    came = link.other.received(count).at_ns
    one_way = [(at - link.echo.sent_ns[number]) / 1e6 for number, at in came.items() if number in link.echo.sent_ns]
    back = [ms for ms in trips if ms is not None]
    return {
        "one_way_ms": _percentiles(one_way),
        "round_trip_ms": _percentiles(back),
        "lost": 1 - len(back) / count,
    }


def _flow(link: Link, size: int, megabytes: float) -> dict[str, float]:
    count = min(_MOST_IN_FLOW, max(1, round(megabytes * 1e6 / size)))
    payloads = [echo.numbered(number, size) for number in range(count)]
    for payload in payloads[:_FIRST]:
        link.bus.put(FLOW, payload, VIEW)
    link.other.received(len(payloads[:_FIRST]))
    began = time.time_ns()
    for payload in payloads:
        link.bus.put(FLOW, payload, VIEW)
    came = link.other.received(count).at_ns
    seconds = (max(came.values(), default=began) - began) / 1e9
    rate = len(came) / seconds if came else 0.0
    return {"messages_per_s": rate, "mb_per_s": rate * size / 1e6, "lost_in_flow": 1 - len(came) / count}


def _codec_ms(size: int) -> dict[str, float]:
    """What it takes to pack and to unpack a Frame whose image is so many bytes."""
    frame = _frame(0, np.zeros(size, np.uint8), "jpeg", 1, 1)
    payload = encode(frame)
    return {
        "encode_ms": _median_cpu_ms(lambda: encode(frame)),
        "decode_ms": _median_cpu_ms(lambda: decode(payload, Frame, FRAME.max_bytes)),
    }


def _frames(link: Link, width: int, height: int, count: int) -> dict[str, float]:
    """CPU milliseconds of a frame from the camera's JPEG file to its pixels in all receivers, in both ways.

    What the sending process and the one at the other end take is measured, all their threads together; the latter
    counts once a receiver, the former once, for shared memory is written once.
    """
    encoded, jpeg = cv2.imencode(".jpg", _picture(width, height), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert encoded
    file = jpeg.reshape(-1)
    figures: dict[str, float] = {
        "jpeg_bytes": len(file),
        "rgb8_bytes": 3 * width * height,
        "decode_jpeg_ms_cpu": _median_cpu_ms(lambda: decoded(file)),
    }
    ways: tuple[Encoding, ...] = ("jpeg", "rgb8")
    for encoding in ways:
        sending, receiving, to_pixels = _series(link, file, encoding, (width, height), count)
        figures |= {
            f"{encoding}_ms_cpu": sending + RECEIVERS * receiving,
            f"{encoding}_ms_cpu_sender": sending,
            f"{encoding}_ms_cpu_receiver": receiving,
            f"{encoding}_ms_to_pixels": to_pixels,
        }
    return figures


def _series(
    link: Link, file: np.ndarray, encoding: Encoding, size: tuple[int, int], count: int
) -> tuple[float, float, float]:
    """CPU milliseconds a frame of the sender and of the receiver, and the median time until it has the pixels."""
    sent_ns: dict[int, int] = {}

    def send(number: int) -> None:
        sent_ns[number] = time.time_ns()
        image = decoded(file) if encoding == "rgb8" else file
        link.bus.put(FRAMES, encode(_frame(number, image, encoding, *size)), FRAME)

    for number in range(_FIRST):
        send(number)
    link.other.received(_FIRST)
    began, cpu_s = time.perf_counter(), time.process_time()
    for number in range(_FIRST, _FIRST + count):
        send(number)
        time.sleep(max(0.0, began + (number - _FIRST + 1) / _FRAMES_HZ - time.perf_counter()))
    cpu_s = time.process_time() - cpu_s
    came = link.other.received(count)
    arrived = max(len(came.at_ns), 1)
    to_pixels = [(at - sent_ns[number]) / 1e6 for number, at in came.at_ns.items()]
    return 1e3 * cpu_s / count, 1e3 * came.cpu_s / arrived, float(np.median(to_pixels)) if to_pixels else 0.0


def _frame(number: int, image: np.ndarray, encoding: Encoding, width: int, height: int) -> Frame:
    camera = Camera(width, height, width, width, width / 2, height / 2)
    return Frame(header=first_header(number, time.time_ns()), image=image, encoding=encoding, camera=camera)


def _picture(width: int, height: int) -> np.ndarray:
    """The demo scene's test images side by side, (height, width, 3) uint8 BGR, as detailed as they were taken."""
    dataset = load_dataset(demo_file("transforms_test.json").parent, "test")
    side = dataset.images[0].camera
    rows, columns = -(-height // side.height), -(-width // side.width)
    tiles = [dataset.load_rgb(i % len(dataset)) for i in range(rows * columns)]
    whole = np.vstack([np.hstack(tiles[row * columns : (row + 1) * columns]) for row in range(rows)])
    return np.ascontiguousarray(whole[:height, :width, ::-1])


def _percentiles(values: Sequence[float]) -> dict[str, float | None]:
    return {f"p{p}": float(np.percentile(values, p)) if values else None for p in _PERCENTILES}


def _median_cpu_ms(work: Callable[[], object]) -> float:
    times = []
    for _ in range(_TIMES):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return 1e3 * float(np.median(times))
