"""Numbering, counting and queueing at the ends of a bus; joining by frame and pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_samples import ADDRESS, camera_info, failure, frame, guess, prior, truth, view

from fieldpose.bus.joining import Joined, Joiner
from fieldpose.bus.messages import Header, Message, Reason
from fieldpose.bus.ports import Inbox, Outbox, Sequences, reply_header
from fieldpose.bus.topics import ALL, CAMERA_INFO, FAILURE, FRAME, GUESS, PRIOR, TRUTH, VIEW, Topic
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
        told: list[tuple[Topic[Any], str]] = []
        inbox = Inbox(bus, ADDRESS, [GUESS], refused=lambda topic, error: told.append((topic, str(error))))
        bus.put(ADDRESS.key(GUESS), b"rubbish", GUESS)
        Outbox(bus, ADDRESS, "tracking").publish(GUESS, guess(5))
        received = inbox.get(1.0)
        assert received is not None
        assert received.message.header.frame_id == 5
        assert (inbox.counts.refused, inbox.counts.received) == (1, 1)
        assert told[0][0] is GUESS
        assert told[0][1].startswith("Guess: ")

    def test_several_senders_on_the_one_failure_topic_are_counted_each_by_itself(self) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [FAILURE])
        stages = ("matching", "lifting", "pnp")
        outboxes = {stage: Outbox(bus, ADDRESS, stage) for stage in stages}
        failing = [stages[n] for n in (0, 0, 0, 2, 1, 0, 2, 2, 1, 0)]
        for frame_id, stage in enumerate(failing):
            outboxes[stage].publish(FAILURE, failure(frame_id, stage))
        received = inbox.drain()
        assert [item.message.header.source for item in received] == failing
        assert [item.message.header.sequence for item in received] == [0, 1, 2, 0, 0, 3, 1, 2, 1, 4]
        assert {item.key for item in received} == {"test/track/mug/cam/failure"}
        assert (inbox.counts.received, inbox.counts.gaps, inbox.counts.skipped) == (10, 0, 0)

    def test_a_failure_that_is_lost_is_a_gap_of_its_sender_alone(self) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [FAILURE], {FAILURE: 3})
        pnp, lifting = Outbox(bus, ADDRESS, "pnp"), Outbox(bus, ADDRESS, "lifting")
        for sender in (pnp, lifting):
            sender.publish(FAILURE, failure(0))
        assert len(inbox.drain()) == 2
        for frame_id in (1, 2, 3):
            pnp.publish(FAILURE, failure(frame_id, "pnp", Reason.NO_CONSENSUS))
        lifting.publish(FAILURE, failure(4, "lifting", Reason.TOO_FEW_CONSISTENT_POINTS))
        assert [item.message.header.frame_id for item in inbox.drain()] == [2, 3, 4]
        assert inbox.counts.gaps == 1

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


def joined_ids(results: Iterable[Joined]) -> list[tuple[int, int]]:
    return [(each[VIEW].header.frame_id, each[VIEW].header.pass_index) for each in results]


ONE_A_FRAME: dict[Topic[Any], Callable[[int], Message]] = {
    FRAME: frame,
    CAMERA_INFO: camera_info,
    TRUTH: truth,
    PRIOR: prior,
}
one_a_frame = pytest.mark.parametrize("topic", ONE_A_FRAME, ids=lambda topic: topic.name)


class TestJoined:
    def test_it_has_the_header_of_the_answer(self) -> None:
        driving = view(4, pass_index=2)
        driving.header = Header("rendering", 9, 4, 2, 1004, 2000)
        (joined,) = Joiner((VIEW,)).add(VIEW, driving, 0)
        assert joined.header == Header("", 0, 4, 2, 1004, 0)
        assert joined[VIEW] is driving

    def test_an_input_that_is_missing_is_a_key_error_that_names_it_or_none(self) -> None:
        joined = Joined(view(4).header, {VIEW: view(4)}, (FRAME,))
        assert joined.get(FRAME) is None
        assert joined.missing == (FRAME,)
        with pytest.raises(KeyError, match="frame"):
            joined[FRAME]

    def test_the_passes_of_a_frame_have_its_key_and_another_frame_of_that_id_has_not(self) -> None:
        headers = [Header("", 0, 4, 0, 1004, 0), Header("", 0, 4, 1, 1004, 5), Header("", 0, 4, 0, 9004, 0)]
        first, second, after_a_restart = (Joined(header, {}).frame_key for header in headers)
        assert first == second != after_a_restart


class TestJoiner:
    def test_any_order_of_arrival(self) -> None:
        arrivals: list[tuple[Topic[Any], Message]] = [(FRAME, frame(1)), (VIEW, view(1))]
        for first, second in (arrivals, arrivals[::-1]):
            joiner = Joiner((VIEW, FRAME))
            assert list(joiner.add(*first, 0)) == []
            (joined,) = joiner.add(*second, 0)
            assert joined[FRAME].header.frame_id == joined[VIEW].header.frame_id == joined.header.frame_id == 1
            assert joined.missing == ()

    def test_only_what_a_camera_and_the_outside_send_is_there_once_a_frame(self) -> None:
        assert {topic for topic in ALL if topic.of_frame} == set(ONE_A_FRAME)

    @one_a_frame
    def test_what_is_there_once_a_frame_serves_every_pass_and_comes_out_once_for_each(self, topic: Topic[Any]) -> None:
        joiner = Joiner((VIEW, topic))
        sent = ONE_A_FRAME[topic](1)
        list(joiner.add(topic, sent, 0))
        for pass_index in (0, 1, 2):
            (joined,) = joiner.add(VIEW, view(1, pass_index), 0)
            assert joined[topic] is sent
            assert joined.header.pass_index == pass_index
        assert list(joiner.add(topic, sent, 0)) == []

    def test_other_inputs_are_joined_by_pass_too_and_used_once(self) -> None:
        joiner = Joiner((VIEW, GUESS))
        list(joiner.add(GUESS, guess(1, 0), 0))
        assert list(joiner.add(VIEW, view(1, 1), 0)) == []
        assert joined_ids(joiner.add(GUESS, guess(1, 1), 0)) == [(1, 1)]
        assert joined_ids(joiner.add(VIEW, view(1, 0), 0)) == [(1, 0)]
        assert list(joiner.add(VIEW, view(1, 0), 0)) == []

    @one_a_frame
    def test_several_passes_may_wait_for_what_is_there_once_a_frame(self, topic: Topic[Any]) -> None:
        joiner = Joiner((VIEW, topic))
        list(joiner.add(VIEW, view(1, 0), 0))
        list(joiner.add(VIEW, view(1, 1), 0))
        assert joined_ids(joiner.add(topic, ONE_A_FRAME[topic](1), 0)) == [(1, 0), (1, 1)]

    @one_a_frame
    def test_frames_of_a_camera_that_started_again_are_not_taken_for_the_old(self, topic: Topic[Any]) -> None:
        joiner = Joiner((VIEW, topic))
        old = ONE_A_FRAME[topic](1)
        old.header = Header("", 0, 1, 0, 5, 0)
        list(joiner.add(topic, old, 0))
        assert list(joiner.add(VIEW, view(1), 0)) == []
        assert joined_ids(joiner.add(topic, ONE_A_FRAME[topic](1), 0)) == [(1, 0)]

    def test_what_is_there_once_a_frame_may_drive(self) -> None:
        joiner = Joiner((CAMERA_INFO, PRIOR))
        assert list(joiner.add(CAMERA_INFO, camera_info(1), 0)) == []
        assert list(joiner.add(PRIOR, prior(2), 0)) == []
        (joined,) = joiner.add(PRIOR, prior(1), 0)
        assert joined[CAMERA_INFO].camera == camera_info(1).camera
        assert list(joiner.add(PRIOR, prior(1), 0)) == []

    def test_what_waits_too_long_comes_out_incomplete_once(self) -> None:
        joiner = Joiner((VIEW, FRAME, GUESS), timeout_s=1.0)
        list(joiner.add(VIEW, view(1), 0))
        list(joiner.add(GUESS, guess(1), 0))
        assert list(joiner.expire(SECOND_NS - 1)) == []
        (late,) = joiner.expire(SECOND_NS)
        assert late.missing == (FRAME,)
        assert late.get(FRAME) is None
        assert late[VIEW].header.frame_id == late[GUESS].header.frame_id == 1
        assert list(joiner.expire(10 * SECOND_NS)) == []
        assert list(joiner.add(FRAME, frame(1), 0)) == []

    @pytest.mark.parametrize("topic", [FRAME, CAMERA_INFO])
    def test_what_a_camera_has_left_behind_is_not_waited_for(self, topic: Topic[Any]) -> None:
        joiner = Joiner((VIEW, topic))
        list(joiner.add(VIEW, view(5), 0))
        assert list(joiner.add(topic, ONE_A_FRAME[topic](4), 0)) == []
        (joined,) = joiner.add(topic, ONE_A_FRAME[topic](6), 0)
        assert (joined.header.frame_id, joined.missing) == (5, (topic,))
        (joined,) = joiner.add(VIEW, view(5, 1), 0)
        assert joined.missing == (topic,)
        assert joined_ids(joiner.add(VIEW, view(6), 0)) == [(6, 0)]

    def test_what_others_send_of_a_frame_may_come_in_any_order(self) -> None:
        joiner = Joiner((VIEW, PRIOR))
        list(joiner.add(VIEW, view(5), 0))
        assert list(joiner.add(PRIOR, prior(6), 0)) == []
        assert joined_ids(joiner.add(PRIOR, prior(5), 0)) == [(5, 0)]

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
