"""Numbering, counting and queueing at the ends of a bus; joining by frame and pass."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_samples import ADDRESS, frame, guess, truth, view

from fieldpose.bus.joining import Joiner
from fieldpose.bus.messages import Header
from fieldpose.bus.ports import Inbox, Outbox, Sequences, reply_header
from fieldpose.bus.topics import FRAME, GUESS, TRUTH, VIEW, Topic
from fieldpose.bus.transport import MemoryBus
from fieldpose.errors import CodecError

SECOND_NS = 10**9


def gaps(numbers: list[int], from_start: bool = False) -> list[int]:
    sequences = Sequences(from_start)
    return [sequences.seen("key", Header("pnp", number, 0, 0, 0, 0)) for number in numbers]


class TestSequences:
    def test_gaps_are_counted_where_they_show(self) -> None:
        assert gaps([0, 1, 4, 5, 9]) == [0, 0, 2, 0, 3]

    def test_joining_late_is_a_gap_only_where_the_start_was_awaited(self) -> None:
        assert gaps([7, 8]) == [0, 0]
        assert gaps([7, 8], from_start=True) == [7, 0]

    def test_a_sender_that_started_again_has_lost_what_is_before_its_first(self) -> None:
        assert gaps([5, 6, 0, 1]) == [0, 0, 0, 0]
        assert gaps([5, 6, 2, 3]) == [0, 0, 2, 0]

    def test_senders_are_counted_apart(self) -> None:
        sequences = Sequences()
        for key, source, number in [("a", "x", 0), ("a", "y", 5), ("b", "x", 9), ("a", "x", 3), ("a", "y", 6)]:
            sequences.seen(key, Header(source, number, 0, 0, 0, 0))
        assert sequences.missing == {("a", "x"): 2, ("a", "y"): 0, ("b", "x"): 0}

    @settings(derandomize=True, deadline=None)
    @given(st.sets(st.integers(1, 60), max_size=50))
    def test_received_and_missing_make_up_what_was_sent(self, lost: set[int]) -> None:
        numbers = [number for number in range(62) if number not in lost]
        assert len(numbers) + sum(gaps(numbers)) == 62


class TestOutbox:
    def test_headers_are_filled_in_and_numbered_per_topic(self) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [GUESS, TRUTH])
        outbox = Outbox(bus, ADDRESS, "tracking")
        asked = guess(4, pass_index=2)
        outbox.publish(GUESS, asked)
        outbox.publish(GUESS, asked)
        outbox.publish(TRUTH, truth(4))
        headers = [item.message.header for item in inbox.drain()]
        assert [(header.source, header.sequence) for header in headers] == [("tracking", n) for n in (0, 1, 0)]
        assert (headers[0].frame_id, headers[0].pass_index, headers[0].capture_ns) == (4, 2, 1004)
        assert headers[0].sent_ns > 0
        assert asked.header.source == "", "the caller's message is left as it was"

    def test_a_message_that_cannot_be_sent_takes_no_number(self) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [GUESS])
        outbox = Outbox(bus, ADDRESS, "tracking")
        bad = guess()
        bad.cam_from_object = bad.cam_from_object[:3]
        with pytest.raises(CodecError):
            outbox.publish(GUESS, bad)
        outbox.publish(GUESS, guess())
        assert [item.message.header.sequence for item in inbox.drain()] == [0]

    def test_an_answer_keeps_frame_pass_and_capture_time(self) -> None:
        header = reply_header(Header("camera", 9, 4, 2, 1004, 2000))
        assert header == Header("", 0, 4, 2, 1004, 0)


class TestInbox:
    def test_what_is_no_message_is_refused_told_and_passed_over(self) -> None:
        bus = MemoryBus()
        told: list[tuple[Topic, str]] = []
        inbox = Inbox(bus, ADDRESS, [GUESS], refused=lambda topic, error: told.append((topic, str(error))))
        bus.put(ADDRESS.key(GUESS), b"rubbish", GUESS)
        Outbox(bus, ADDRESS, "tracking").publish(GUESS, guess(5))
        received = inbox.get(1.0)
        assert received is not None
        assert received.message.header.frame_id == 5
        assert (inbox.counts.refused, inbox.counts.received) == (1, 1)
        assert told[0][0] is GUESS
        assert told[0][1].startswith("Guess: ")

    def test_a_fast_camera_does_not_starve_other_topics_nor_they_it(self) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [FRAME, GUESS])
        camera, tracking = Outbox(bus, ADDRESS, "camera"), Outbox(bus, ADDRESS, "tracking")
        order = []
        for frame_id in range(40):
            camera.publish(FRAME, frame(frame_id))
            tracking.publish(GUESS, guess(frame_id))
            if frame_id % 2:
                received = inbox.get(0.0)
                assert received is not None
                order.append(received.topic)
        assert order.count(FRAME) >= 3
        assert order.count(GUESS) >= 3


def joined_ids(results: object) -> list[tuple[int, int]]:
    return [(each.inputs[VIEW].header.frame_id, each.inputs[VIEW].header.pass_index) for each in results]  # type: ignore


class TestJoiner:
    def test_any_order_of_arrival(self) -> None:
        for first, second in [((FRAME, frame(1)), (VIEW, view(1))), ((VIEW, view(1)), (FRAME, frame(1)))]:
            joiner = Joiner((VIEW, FRAME))
            assert list(joiner.add(*first, 0)) == []
            (joined,) = joiner.add(*second, 0)
            assert joined.inputs[FRAME].header.frame_id == joined.inputs[VIEW].header.frame_id == 1
            assert joined.missing == ()

    def test_a_frame_serves_every_pass_and_comes_out_once_for_each(self) -> None:
        joiner = Joiner((VIEW, FRAME))
        list(joiner.add(FRAME, frame(1), 0))
        assert joined_ids(joiner.add(VIEW, view(1, 0), 0)) == [(1, 0)]
        assert joined_ids(joiner.add(VIEW, view(1, 1), 0)) == [(1, 1)]
        assert list(joiner.add(FRAME, frame(1), 0)) == []

    def test_other_inputs_are_joined_by_pass_too_and_used_once(self) -> None:
        joiner = Joiner((VIEW, GUESS))
        list(joiner.add(GUESS, guess(1, 0), 0))
        assert list(joiner.add(VIEW, view(1, 1), 0)) == []
        assert joined_ids(joiner.add(GUESS, guess(1, 1), 0)) == [(1, 1)]
        assert joined_ids(joiner.add(VIEW, view(1, 0), 0)) == [(1, 0)]
        assert list(joiner.add(VIEW, view(1, 0), 0)) == []

    def test_several_passes_may_wait_for_one_frame(self) -> None:
        joiner = Joiner((VIEW, FRAME))
        list(joiner.add(VIEW, view(1, 0), 0))
        list(joiner.add(VIEW, view(1, 1), 0))
        assert joined_ids(joiner.add(FRAME, frame(1), 0)) == [(1, 0), (1, 1)]

    def test_frames_of_a_camera_that_started_again_are_not_taken_for_the_old(self) -> None:
        joiner = Joiner((VIEW, FRAME))
        old = frame(1, header=Header("", 0, 1, 0, 5, 0))
        list(joiner.add(FRAME, old, 0))
        assert list(joiner.add(VIEW, view(1), 0)) == []
        assert joined_ids(joiner.add(FRAME, frame(1), 0)) == [(1, 0)]

    def test_what_waits_too_long_comes_out_incomplete_once(self) -> None:
        joiner = Joiner((VIEW, FRAME, GUESS), timeout_s=1.0)
        list(joiner.add(VIEW, view(1), 0))
        list(joiner.add(GUESS, guess(1), 0))
        assert list(joiner.expire(SECOND_NS - 1)) == []
        (late,) = joiner.expire(SECOND_NS)
        assert late.missing == (FRAME,)
        assert set(late.inputs) == {VIEW, GUESS}
        assert list(joiner.expire(10 * SECOND_NS)) == []
        assert list(joiner.add(FRAME, frame(1), 0)) == []

    def test_memory_is_bounded_and_nothing_that_drives_is_lost(self) -> None:
        joiner = Joiner((VIEW, FRAME))
        out = [each for frame_id in range(200) for each in joiner.add(VIEW, view(frame_id), 0)]
        assert len(out) == 200 - 64
        assert all(each.missing == (FRAME,) for each in out)
        for frame_id in range(200):
            list(joiner.add(FRAME, frame(1000 + frame_id), 0))
        assert [len(list(joiner.add(VIEW, view(1000 + n), 0))) for n in (135, 136, 199)] == [1, 1, 1]
        complete = [each.missing == () for each in joiner.expire(2 * SECOND_NS)]
        assert not any(complete)
