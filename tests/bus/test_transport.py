"""One contract for every bus, and what only the one over Zenoh can show: processes that come, go and die."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from support.bus_samples import ADDRESS, every_message, failure, frame, guess, same, truth

from fieldpose.bus import shared_memory
from fieldpose.bus.ports import Inbox, Outbox
from fieldpose.bus.topics import ALL, BY_NAME, FAILURE, FRAME, GUESS, STATS, TRUTH, Address, topic_of
from fieldpose.bus.transport import Bus, MemoryBus, ZenohBus, serve_hub, wait_for
from fieldpose.errors import TransportError

T = TypeVar("T")

Sessions = tuple[Bus, Bus]
Connect = Callable[[str], ZenohBus]
Spawn = Callable[..., "subprocess.Popen[str]"]


def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    return condition()


def eventually(value: Callable[[], T], expected: T, timeout_s: float = 5.0) -> None:
    until(lambda: value() == expected, timeout_s)
    assert value() == expected


def meet(sender: Bus, receiver: Bus) -> None:
    """Return once the receiver, subscribed already, is known to the sender."""
    receiver.hold(ADDRESS.live("receiver"))
    wait_for(sender, ADDRESS, ["receiver"], 5.0)


class TestContract:
    def test_every_message_arrives_in_order_with_its_key(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [GUESS])
        meet(sender, receiver)
        outbox = Outbox(sender, ADDRESS, "tracking")
        for frame_id in range(50):
            outbox.publish(GUESS, guess(frame_id))
        received = [inbox.get(5.0) for _ in range(50)]
        assert [item.message.header.frame_id for item in received if item] == list(range(50))
        assert [item.message.header.sequence for item in received if item] == list(range(50))
        assert {(item.key, item.message.header.source) for item in received if item} == {
            ("test/track/mug/cam/guess", "tracking")
        }
        assert inbox.counts.gaps == 0

    def test_an_image_arrives_as_it_was(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [FRAME])
        meet(sender, receiver)
        sent = frame(7, width=480, height=360)
        Outbox(sender, ADDRESS, "camera").publish(FRAME, sent)
        received = inbox.get(5.0)
        assert received is not None
        assert same(received.message.image, sent.image)  # type: ignore[attr-defined]
        assert not received.message.image.flags.writeable  # type: ignore[attr-defined]

    def test_a_message_of_every_topic_arrives_as_it_was(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, ALL)
        meet(sender, receiver)
        outbox = Outbox(sender, ADDRESS, "pnp")
        for topic, message in every_message().items():
            outbox.publish(topic, message)
        received = [inbox.get(5.0) for _ in ALL]
        assert {item.topic for item in received if item} == set(ALL)
        for item in received:
            assert item is not None
            sent = every_message()[item.topic]
            sent.header = item.message.header
            assert same(item.message, sent)
            assert item.key == ADDRESS.key(item.topic, "pnp")

    def test_the_failures_of_several_stages_have_no_gaps(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [FAILURE])
        meet(sender, receiver)
        outboxes = [Outbox(sender, ADDRESS, stage) for stage in ("matching", "lifting", "pnp")]
        for frame_id in range(30):
            outboxes[frame_id * 7 % 3].publish(FAILURE, failure(frame_id))
            outboxes[0].publish(FAILURE, failure(frame_id))
        received = [inbox.get(5.0) for _ in range(60)]
        sources = [item.message.header.source for item in received if item]
        assert [sources.count(stage) for stage in ("matching", "lifting", "pnp")] == [40, 10, 10]
        assert inbox.counts.gaps == 0

    def test_other_keys_do_not_arrive_and_wildcards_listen_to_several(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        everything = Inbox(receiver, Address("test", "*", "*"), [GUESS])
        only_mug = Inbox(receiver, ADDRESS, [GUESS, TRUTH])
        meet(sender, receiver)
        Outbox(sender, Address("test", "cup", "cam"), "tracking").publish(GUESS, guess(1))
        Outbox(sender, Address("elsewhere", "mug", "cam"), "tracking").publish(GUESS, guess(2))
        Outbox(sender, ADDRESS, "tracking").publish(GUESS, guess(3))
        assert [item.message.header.frame_id for item in (everything.get(5.0), everything.get(5.0)) if item] == [
            1,
            3,
        ]
        mug = only_mug.get(5.0)
        assert mug is not None
        assert mug.message.header.frame_id == 3
        assert everything.get(0.05) is None
        assert only_mug.get(0.0) is None

    def test_a_newest_only_input_holds_the_newest_and_counts_what_it_let_go(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [FRAME])
        meet(sender, receiver)
        outbox = Outbox(sender, ADDRESS, "camera")
        outbox.publish(FRAME, frame(0))
        assert inbox.get(5.0) is not None
        for frame_id in range(1, 11):
            outbox.publish(FRAME, frame(frame_id))
        last = []
        assert until(lambda: last.extend(inbox.drain()) or bool(last and last[-1].message.header.frame_id == 10))
        assert inbox.counts.skipped + inbox.counts.received == 11
        assert inbox.counts.gaps == 0
        assert len(last) < 10

    def test_a_full_queue_drops_its_oldest_and_counts_the_gap(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [GUESS, TRUTH], {GUESS: 4})
        meet(sender, receiver)
        outbox = Outbox(sender, ADDRESS, "tracking")
        outbox.publish(GUESS, guess(0))
        assert inbox.get(5.0) is not None
        for frame_id in range(1, 11):
            outbox.publish(GUESS, guess(frame_id))
        outbox.publish(TRUTH, truth(99))
        time.sleep(0.3)
        received = inbox.drain()
        assert [item.message.header.frame_id for item in received if item.topic is GUESS] == [7, 8, 9, 10]
        assert [item.message.header.frame_id for item in received if item.topic is TRUTH] == [99]
        assert inbox.counts.gaps == 6

    def test_nothing_arrives_after_the_end_of_a_subscription(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [GUESS])
        meet(sender, receiver)
        inbox.close()
        Outbox(sender, ADDRESS, "tracking").publish(GUESS, guess())
        assert inbox.get(0.1) is None

    def test_a_waiting_reader_wakes_at_once(self, sessions: Sessions) -> None:
        sender, receiver = sessions
        inbox = Inbox(receiver, ADDRESS, [GUESS])
        meet(sender, receiver)
        outbox = Outbox(sender, ADDRESS, "tracking")
        outbox.publish(GUESS, guess())
        assert inbox.get(5.0) is not None
        delays_ms = []
        for _ in range(20):
            threading.Timer(0.01, outbox.publish, (GUESS, guess())).start()
            received = inbox.get(5.0)
            assert received is not None
            delays_ms.append((time.time_ns() - received.message.header.sent_ns) / 1e6)
        assert sorted(delays_ms)[10] < 15.0

    def test_tokens_appear_and_disappear(self, sessions: Sessions) -> None:
        ours, theirs = sessions
        changes: list[tuple[str, bool]] = []
        before = theirs.hold("test/live/mug/cam/before")
        eventually(lambda: ours.live("test/live/*/*/*"), {"test/live/mug/cam/before"})
        watching = ours.watch("test/live/mug/cam/*", lambda key, alive: changes.append((key.split("/")[-1], alive)))
        theirs.hold("test/live/cup/cam/other")
        later = theirs.hold("test/live/mug/cam/later")
        assert until(lambda: len(changes) == 2)
        before.close()
        assert until(lambda: len(changes) == 3)
        watching.close()
        later.close()
        eventually(lambda: ours.live("test/live/mug/*/*"), set())
        assert changes == [("before", True), ("later", True), ("before", False)]

    def test_closing_a_session_lets_its_tokens_go(self, sessions: Sessions) -> None:
        ours, theirs = sessions
        theirs.hold(ADDRESS.live("pnp"))
        eventually(lambda: ours.live(ADDRESS.live("*")), {"test/live/mug/cam/pnp"})
        theirs.close()
        eventually(lambda: ours.live(ADDRESS.live("*")), set())

    def test_waiting_for_stages_names_the_missing_ones(self, sessions: Sessions) -> None:
        ours, theirs = sessions
        theirs.hold(ADDRESS.live("pnp"))
        wait_for(ours, ADDRESS, ["pnp"], 5.0)
        with pytest.raises(TransportError, match=r"after 0\.1 s: camera, lifting; is"):
            wait_for(ours, ADDRESS, ["lifting", "pnp", "camera"], 0.1)

    def test_stages_of_other_pipelines_are_waited_for_by_their_object_and_camera(self, sessions: Sessions) -> None:
        ours, theirs = sessions
        for address in (ADDRESS, Address("test", "bowl", "left"), Address("elsewhere", "bowl", "right")):
            theirs.hold(address.live("pnp"))
        wait_for(ours, ADDRESS, ["pnp", "bowl/left/pnp"], 5.0)
        with pytest.raises(TransportError, match=r"after 0\.1 s: bowl/right/pnp; is"):
            wait_for(ours, ADDRESS, ["pnp", "bowl/left/pnp", "bowl/right/pnp"], 0.1)
        with pytest.raises(TransportError, match="expected STAGE or OBJECT/CAMERA/STAGE"):
            wait_for(ours, ADDRESS, ["left/pnp"], 0.1)

    def test_a_late_stage_is_waited_for(self, sessions: Sessions) -> None:
        ours, theirs = sessions
        threading.Timer(0.1, theirs.hold, (ADDRESS.live("late"),)).start()
        wait_for(ours, ADDRESS, ["late"], 5.0)
        assert ADDRESS.live("late") in ours.live(ADDRESS.live("*"))


class TestKeys:
    def test_stats_keys_name_the_stage(self) -> None:
        assert ADDRESS.key(STATS, "pnp") == "test/stats/mug/cam/pnp"
        assert STATS.address_of("test/stats/mug/cam/pnp") == ADDRESS
        assert all(ADDRESS.covers(key) for key in ("test/stats/mug/cam/pnp", "test/camera/cam/frame"))
        others = ("test/camera/cam2/frame", "test/stats/bowl/cam/pnp", "test/track")
        assert not any(ADDRESS.covers(key) for key in others)

    def test_every_key_leads_back_to_its_topic_alone(self) -> None:
        keys = {topic: ADDRESS.key(topic, "pnp") for topic in ALL}
        assert len(set(keys.values())) == len(set(BY_NAME)) == len(ALL)
        for topic, key in keys.items():
            assert topic_of(key) is topic is BY_NAME[topic.name]
            at = topic.address_of(key)
            assert at is not None
            assert (at.site, at.camera) == ("test", "cam")

    def test_what_a_camera_sends_is_for_every_object(self) -> None:
        other = Address("test", "cup", "cam")
        assert [topic.name for topic in ALL if ADDRESS.key(topic) == other.key(topic)] == ["frame", "camera_info"]

    @pytest.mark.parametrize("part", ["", "a/b", "a b", "**", "a*", "é"])
    def test_a_part_that_is_no_part_is_refused(self, part: str) -> None:
        with pytest.raises(TransportError):
            Address(object=part)


HOLDER = """
    import sys, time
    from fieldpose.bus.transport import ZenohBus
    from support.bus_samples import ADDRESS, frame
    from fieldpose.bus.ports import Outbox
    from fieldpose.bus.topics import FRAME
    bus = ZenohBus(sys.argv[1])
    bus.hold(ADDRESS.live("camera"))
    outbox = Outbox(bus, ADDRESS, "camera")
    for frame_id in range(100_000):
        outbox.publish(FRAME, frame(frame_id, width=120, height=90))
        time.sleep(0.02)
"""


def pools_of_this_process() -> set[str]:
    """The files of shared memory of at least 16 MB that this process has mapped."""
    mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if ".zenoh" in line}
    return {path for path in mapped if Path(path).exists() and Path(path).stat().st_size >= 16 << 20}


CLAIMS = """
    from fieldpose.bus import shared_memory
    settings = shared_memory.settings()
    assert "may lock 4 MB of memory; allow 1024" in shared_memory.hindrance()
    print(settings["transport/shared_memory/enabled"],
          settings["transport/shared_memory/transport_optimization/enabled"])
"""
HUB = "import sys; from fieldpose.bus.transport import serve_hub; serve_hub(sys.argv[1])"


class TestProcesses:
    def test_a_killed_process_loses_its_token_soon(self, hub: str, connect: Connect, spawn: Spawn) -> None:
        bus = connect(hub)
        process = spawn(HOLDER, hub)
        wait_for(bus, ADDRESS, ["camera"], 10.0)
        process.send_signal(signal.SIGKILL)
        eventually(lambda: bus.live(ADDRESS.live("camera")), set(), 1.0)

    def test_any_order_of_start_and_a_hub_that_dies(self, endpoint: str, connect: Connect, spawn: Spawn) -> None:
        bus = connect(endpoint)
        with pytest.raises(TransportError, match="no hub answers"):
            bus.wait_for_hub(0.05)
        spawn(HOLDER, endpoint)
        inbox = Inbox(bus, ADDRESS, [FRAME])
        first = spawn(HUB, endpoint)
        bus.wait_for_hub(10.0)
        assert inbox.get(10.0) is not None
        first.kill()
        first.wait()
        time.sleep(0.2)
        inbox.drain()
        assert inbox.get(5.0) is not None, "links between peers outlive the hub"
        second = spawn(HUB, endpoint)
        bus.wait_for_hub(10.0)
        late = Inbox(connect(endpoint), ADDRESS, [FRAME])
        assert late.get(10.0) is not None
        inbox.drain()
        assert inbox.get(5.0) is not None
        second.terminate()
        assert second.wait(5.0) == 0

    def test_a_flood_of_greetings_stops_nobody(self, hub: str, connect: Connect) -> None:
        bus, crowd = connect(hub), connect(hub)
        meet(crowd, bus)
        greeting = b'{"held": [], "changes": 0, "number": 1}' + b" " * 8192
        held = threading.Event()

        def hold() -> None:
            for number in range(20):
                bus.hold(ADDRESS.live(f"stage{number}")).close()
            held.set()

        holder = threading.Thread(target=hold, daemon=True)
        for number in range(1500):
            crowd.put(f"peers/{number % 40:032x}", greeting)
            if number == 300:
                holder.start()
        assert held.wait(20.0), "a session waits for itself"

    def test_images_pass_where_shared_memory_is_small(
        self, hub: str, connect: Connect, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        usage = shutil.disk_usage("/")._replace(free=64 << 20)
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
        sender, receiver = connect(hub), connect(hub)
        before = pools_of_this_process()
        inbox = Inbox(receiver, ADDRESS, [FRAME])
        meet(sender, receiver)
        Outbox(sender, ADDRESS, "camera").publish(FRAME, frame(0, width=480, height=360))
        assert inbox.get(5.0) is not None
        assert pools_of_this_process() <= before

    @pytest.mark.parametrize("limited", ["sender", "receiver"])
    def test_images_pass_where_one_may_not_lock_memory(
        self, hub: str, connect: Connect, monkeypatch: pytest.MonkeyPatch, limited: str
    ) -> None:
        """Zenoh loses what a receiver cannot lock; a limit that lets it lock a pool or two is the worst."""
        made = {}
        for name in ("sender", "receiver"):
            allowed = 64 << 20 if name == limited else float("inf")
            monkeypatch.setattr(shared_memory, "lockable_bytes", lambda allowed=allowed: allowed)
            made[name] = connect(hub)
        inbox = Inbox(made["receiver"], ADDRESS, [FRAME])
        meet(made["sender"], made["receiver"])
        Outbox(made["sender"], ADDRESS, "camera").publish(FRAME, frame(0, width=480, height=360))
        assert inbox.get(20.0) is not None

    @pytest.mark.skipif(shutil.which("setpriv") is None or os.getuid() != 0, reason="only root can give up a right")
    def test_those_who_may_lock_little_say_that_they_have_no_shared_memory(self) -> None:
        limit = f"import resource; resource.setrlimit(resource.RLIMIT_MEMLOCK, ({4 << 20}, {4 << 20}))\n"
        without = ["setpriv", "--bounding-set=-ipc_lock", "--inh-caps=-ipc_lock", sys.executable, "-c"]
        program = limit + textwrap.dedent(CLAIMS)
        done = subprocess.run([*without, program], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout) == (0, "False False\n"), done.stderr

    def test_two_hubs_on_one_port_is_one_clear_line(self, hub: str) -> None:
        with pytest.raises(TransportError, match=r"no hub at .* in use") as caught:
            serve_hub(hub)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("address", ["127.0.0.1:7447", "tcp/127.0.0.1", "pigeon/127.0.0.1:7447"])
    def test_an_address_that_is_none_is_refused(self, address: str) -> None:
        with pytest.raises(TransportError):
            ZenohBus(address)

    def test_a_setting_that_is_none_is_refused(self, hub: str) -> None:
        with pytest.raises(TransportError):
            ZenohBus(hub, settings={"transport/nonsense": 1})

    def test_zenoh_logs_to_stderr_and_prints_stay_on_stdout(self, endpoint: str, spawn: Spawn) -> None:
        program = """
            import sys
            from fieldpose.bus.refusals import log_to_stderr
            from fieldpose.bus.transport import ZenohBus
            log_to_stderr("warn")
            print("before", flush=True)
            ZenohBus(sys.argv[1]).close()
            print("after")
        """
        out, err = spawn(program, endpoint).communicate(timeout=20.0)
        assert out == "before\nafter\n"
        assert "zenoh" in err

    def test_memory_buses_are_separate_unless_neighbours(self) -> None:
        inbox = Inbox(MemoryBus(), ADDRESS, [GUESS])
        Outbox(MemoryBus(), ADDRESS, "tracking").publish(GUESS, guess())
        assert inbox.get(0.0) is None
