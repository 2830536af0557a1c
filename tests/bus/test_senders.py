"""Whom a receiver believes: the announced one of a name; and what floods and made-up numbers may cost."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from support.bus_samples import ADDRESS, every_message, failure, guess

from fieldpose.bus import presence, senders
from fieldpose.bus.codec import encode
from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import Header
from fieldpose.bus.node import run_node
from fieldpose.bus.ports import Inbox, Outbox, Sequences
from fieldpose.bus.topics import FAILURE, GUESS, POSE, STATS, Topic
from fieldpose.deploy.processes.collector import Collector


def put(bus: MemoryBus, topic: Topic[Any], header: Header) -> None:
    message = every_message()[topic]
    message.header = header
    bus.put(ADDRESS.key(topic, header.source), encode(message), topic)


def numbers(inbox: Inbox) -> list[int]:
    return [received.message.header.frame_id for received in inbox.drain()]


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus()


def test_where_nobody_has_announced_himself_everyone_is_believed(bus: MemoryBus) -> None:
    inbox = Inbox(bus, ADDRESS, [GUESS])
    for frame_id, source in enumerate(("tracking", "replay", "anyone")):
        Outbox(bus, ADDRESS, source).publish(GUESS, guess(frame_id))
    assert numbers(inbox) == [0, 1, 2]


def test_one_who_writes_the_topic_and_has_announced_himself_is_believed_alone(bus: MemoryBus) -> None:
    told: list[str] = []
    inbox = Inbox(bus, ADDRESS, [GUESS], refused=lambda topic, error: told.append(str(error)))
    true = Outbox(bus, ADDRESS, "tracking")
    token = true.announce()
    true.publish(GUESS, guess(0))
    for source in ("tracking", "evil"):
        Outbox(bus, ADDRESS, source).publish(GUESS, guess(1))
    other = Outbox(bus, ADDRESS, "tracking")
    with_token = other.announce()
    other.publish(GUESS, guess(2))
    outsider = Outbox(bus, ADDRESS, "evil")
    outsider.announce()
    outsider.publish(GUESS, guess(3))
    true.publish(GUESS, guess(4))
    assert numbers(inbox) == [0, 4]
    assert inbox.counts.refused == 4
    assert "a second sender under one name" in " ".join(told)
    assert "not by who writes it here" in told[0]
    assert all("guess: " in line for line in told)
    # The first has died: the second, that has started again, is it now, from its number 0.
    token.close()
    other.publish(GUESS, guess(5))
    assert numbers(inbox) == [5]
    with_token.close()
    Outbox(bus, ADDRESS, "evil").publish(GUESS, guess(6))
    assert numbers(inbox) == []


def test_of_a_topic_with_several_writers_each_is_bound(bus: MemoryBus) -> None:
    inbox = Inbox(bus, ADDRESS, [FAILURE])
    outboxes = [Outbox(bus, ADDRESS, name) for name in ("matching", "pnp")]
    for outbox in outboxes:
        outbox.announce()
        outbox.publish(FAILURE, failure(1))
    Outbox(bus, ADDRESS, "lifting").publish(FAILURE, failure(2))
    assert numbers(inbox) == [1, 1]


def test_a_flood_takes_no_place_of_who_is_believed(bus: MemoryBus) -> None:
    inbox = Inbox(bus, ADDRESS, [POSE, STATS])
    true = Outbox(bus, ADDRESS, "refinement")
    true.announce()
    for number in range(3 * senders.KEPT):
        put(bus, POSE, Header(f"s{number}", number, 9, 0, 0, 0, number))
        if number == 100:
            true.publish(POSE, every_message()[POSE])
    bus.put(ADDRESS.key(POSE), bytes(200_000), POSE)
    assert numbers(inbox) == [3]
    assert inbox.counts.refused == 3 * senders.KEPT + 1


def test_numbers_go_up_and_no_faster_than_messages_can(bus: MemoryBus) -> None:
    inbox = Inbox(bus, ADDRESS, [POSE])
    for number in (0, 1, 1, 0, 2**63 - 1, 17_000_000, 5):
        put(bus, POSE, Header("refinement", number, number % 99, 0, 0, 0, 7))
    assert numbers(inbox) == [0, 1, 5]
    assert (inbox.counts.gaps, inbox.counts.refused) == (3, 4)


def test_made_up_numbers_are_not_taken_for_losses() -> None:
    sequences = Sequences(from_start=True)
    for number in (2**63 - 1, 3, 43_000_000, 5):
        sequences.seen("key", Header("pnp", number, 0, 0, 0, 0))
    assert 0 <= sum(sequences.missing.values()) < 20
    for number in range(5000):
        sequences.seen("key", Header(f"s{number}", 0, 0, 0, 0, 0))
    assert len(sequences.missing) == senders.KEPT


class Idle:
    name, inputs, outputs = "pnp", (), ()

    def start(self) -> None: ...
    def handle(self, topic: object, message: object) -> tuple[()]:
        return ()

    def tick(self, now_ns: int) -> tuple[()]:
        return ()

    def stop(self) -> None: ...


def test_figures_that_cannot_be_sent_end_no_process(bus: MemoryBus, monkeypatch: pytest.MonkeyPatch) -> None:
    import threading

    inbox = Inbox(bus, ADDRESS, [STATS])
    monkeypatch.setattr("fieldpose.bus.node.InboxCounts", lambda: type("C", (), dict.fromkeys(
        ("received", "refused", "gaps", "skipped"), 2**70))())  # fmt: skip
    stop = threading.Event()
    stop.set()
    run_node(Idle(), bus, ADDRESS, stop)
    assert inbox.drain() == []


def test_the_observer_counts_neither_strangers_nor_stages_that_are_others(bus: MemoryBus) -> None:
    collector = Collector(bus, ADDRESS)
    camera = Outbox(bus, ADDRESS, "camera")
    camera.announce()
    from support.bus_samples import frame

    from fieldpose.bus.topics import FRAME

    camera.publish(FRAME, frame(0))
    Outbox(bus, ADDRESS, "camera").publish(FRAME, frame(1))
    put(bus, FRAME, Header("camera", 2**62, 5, 0, 0, 0))
    stats = every_message()[STATS]
    stats.stage = "tracking"  # type: ignore[attr-defined]
    Outbox(bus, ADDRESS, "evil").publish(STATS, stats)
    collector.update()
    assert collector.sent == 1
    assert len(collector.stats) == 0
    collector.close()


def test_a_flood_of_greetings_is_answered_now_and_then() -> None:
    said: list[bytes] = []
    mine = presence.Presence("me", said.append, lambda: ())
    for number in range(5000):
        mine.heard(f"s{number}", b'{"held":[],"changes":0,"number":%d,"to":""}' % (number + 1))
    assert 100 < len(said) < 1500
    mine.close()


def test_a_pose_that_is_none_moves_nothing() -> None:
    from fieldpose.stages.tracking.wire import pose_result

    pose = every_message()[POSE]
    pose.cam_from_object = np.full((4, 4), 1e300)  # type: ignore[attr-defined]
    assert pose_result(pose).cam_from_object is None  # type: ignore[arg-type]


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that goes on in a suspension")
def test_the_time_that_senders_may_have_sent_in_goes_on_while_this_machine_is_suspended(
    bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 0.0)
    boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    monkeypatch.setattr(time, "clock_gettime", lambda clock: boot_s if clock == time.CLOCK_BOOTTIME else 0.0)
    inbox = Inbox(bus, ADDRESS, [GUESS])
    for number, later_s in ((0, 0.0), (20_000, 0.0), (108_000, 3600.0)):
        boot_s += later_s
        put(bus, GUESS, Header("camera", number, number, 0, 1, 1, 7))
    assert numbers(inbox) == [0, 108_000]
