"""Who is let onto a closed bus, and what each role may do there: real sessions, real refusals at both ends."""

from __future__ import annotations

import os
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh
from support.bus_samples import ADDRESS
from support.commands import command

from fieldpose.bus.access import Access, Role, access_control, certificate_of, key_of
from fieldpose.bus.refusals import Refusals, link_reason
from fieldpose.bus.topics import ALL, CONTROL, FRAME, GUESS, PRIOR, STATE, STATS, VIEW
from fieldpose.bus.transport import ZenohBus, wait_for
from fieldpose.deploy.access import run_keys
from fieldpose.deploy.access.certificates import Authority, make_certificates
from fieldpose.deploy.access.checks import closed, listening
from fieldpose.deploy.access.joining import Entry, Joint, access_as, hub_keys, joined, joint
from fieldpose.deploy.access.roles import OPERATOR, PRIOR_SOURCE, PROGRAM, VIEWER, role_named, roles
from fieldpose.deploy.graph import GRAPH, HUB, OBSERVER, Process
from fieldpose.deploy.processes.endpoints import free_port, with_scheme
from fieldpose.errors import FieldposeError, TransportError, UsageError

NAMES = [role.name for role in roles()]
DAY = timedelta(days=1)
READY_S = 20.0


class Hub:
    """A hub in a process of its own, on certificates of a folder."""

    def __init__(self, folder: Path, *entry: str, address: str = "") -> None:
        self.folder = folder
        self.address = address or f"tls/127.0.0.1:{free_port()}"
        self.process = subprocess.Popen(
            command("stage", "hub", "--listen", self.address, *(entry or ("--tls", str(folder)))),
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def session(self, role: str, access: Access | None = None) -> ZenohBus:
        """One that has joined."""
        way = Joint(self.address, access or access_as(self.folder, role))
        bus = way.session()
        way.wait(bus, READY_S)
        return bus

    def says(self, text: str) -> str:
        """The line of its log that has this, once it comes."""
        deadline = time.monotonic() + READY_S
        while time.monotonic() < deadline:
            found = next((line for line in list(self.said) if text in line), None)
            if found is not None:
                return found
            time.sleep(0.02)
        raise AssertionError(f"no {text!r} in {self.said}")

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(READY_S)
        self._reader.join(READY_S)

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.said.extend(line for line in self.process.stderr)


@contextmanager
def a_hub(folder: Path, *entry: str, address: str = "") -> Iterator[Hub]:
    hub = Hub(folder, *entry, address=address)
    try:
        yield hub
    finally:
        hub.close()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates")
    make_certificates(folder, NAMES, valid=DAY)
    return folder


@pytest.fixture(scope="module")
def hub(certificates: Path) -> Iterator[Hub]:
    with a_hub(certificates) as made:
        made.session(VIEWER).close()
        yield made


@pytest.fixture
def sessions(hub: Hub) -> Iterator[Callable[..., ZenohBus]]:
    opened: list[ZenohBus] = []

    def session(role: str, access: Access | None = None) -> ZenohBus:
        opened.append(hub.session(role, access))
        return opened[-1]

    yield session
    for bus in opened:
        bus.close()


def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return condition()


class Rogue(Role):
    """The role of a process that does not keep to its own: nothing is held back at its end."""

    def may(self, deed: str, key: str) -> bool:
        return True


def rogue(folder: Path, name: str) -> Access:
    """The access of a process with a good certificate that tries everything."""
    return replace(access_as(folder, name), role=Rogue(name))


class TestRoles:
    def test_each_process_of_the_graph_has_its_own_and_there_are_no_two_of_a_name(self) -> None:
        assert len(set(NAMES)) == len(NAMES)
        assert {row.name for row in GRAPH} <= set(NAMES)

    @pytest.mark.parametrize("row", [row for row in GRAPH if row.make is not None], ids=lambda row: row.name)
    def test_a_process_may_what_its_row_says_and_nothing_else(self, row: Process) -> None:
        name, role = row.name, role_named(row.name)
        for topic in ALL:
            own = ADDRESS.key(topic, name)
            assert role.may("send on", own) == (topic in row.writes or topic is STATS)
            assert role.may("listen to", own) == (topic in row.reads)
        assert not role.may("send on", ADDRESS.key(STATS, "another"))
        assert not role.may("ask at", ADDRESS.control("tracking"))
        assert role.may("answer at", ADDRESS.control(name))
        assert not role.may("answer at", ADDRESS.control("another"))

    def test_who_stands_around_may_little(self) -> None:
        writers = {
            topic: {role.name for role in roles() if role.may("send on", ADDRESS.key(topic, "x"))} for topic in ALL
        }
        assert writers[GUESS] == writers[STATE] == writers[CONTROL] == {HUB, "tracking"}
        assert writers[PRIOR] == {HUB, "perturbation", PRIOR_SOURCE, PROGRAM}
        assert {role.name for role in roles() if role.asks} == {OPERATOR, PROGRAM}
        for name in (VIEWER, OPERATOR, OBSERVER, "recorder"):
            assert role_named(name).writes == ()

    def test_a_role_that_is_none_is_named_with_those_there_are(self) -> None:
        with pytest.raises(UsageError, match=r"no role 'boss'; expected one of hub, recorder, camera"):
            role_named("boss")

    def test_whoever_has_no_role_may_nothing(self) -> None:
        settings = access_control(roles())
        assert settings["default_permission"] == "deny"
        assert {tuple(subject["cert_common_names"]) for subject in settings["subjects"]} == {(name,) for name in NAMES}
        assert [rule["id"] for rule in settings["rules"] if "**" in rule["key_exprs"]] == ["hub ingress", "hub egress"]


class TestOnTheBus:
    def test_every_message_of_a_role_passes_and_all_others_are_refused(
        self, hub: Hub, certificates: Path, sessions: Callable[..., ZenohBus]
    ) -> None:
        """By sessions that try everything, directly between peers and with nothing held back at the sender's end."""
        heard: set[tuple[str, str]] = set()
        listener = sessions(OBSERVER)
        keys = {topic: ADDRESS.key(topic, "*") for topic in ALL}
        for pattern in keys.values():
            listener.subscribe(pattern, lambda key, payload, at: heard.add((payload.decode(), key)), 256)
        listener.hold(ADDRESS.live(OBSERVER))
        names = [name for name in NAMES if name != HUB]
        senders = {name: sessions(name, rogue(certificates, name)) for name in names}
        for sender in senders.values():
            wait_for(sender, ADDRESS, [OBSERVER], READY_S)
        expected = set()
        for name, sender in senders.items():
            own = {ADDRESS.key(topic, stage) for topic in ALL for stage in (name, "pnp")}
            for key in own:
                sender.put(key, name.encode())
                if role_named(name).may("send on", key):
                    expected.add((name, key))
        assert until(lambda: expected <= heard), expected - heard
        # What is sent after all of it has come, and on the same links: nothing is on its way any more.
        assert all(sender.settle(READY_S) for sender in senders.values())
        assert heard == expected

    def test_nobody_hears_what_is_not_for_its_role(self, certificates: Path, sessions: Callable[..., ZenohBus]) -> None:
        heard: set[tuple[str, str]] = set()
        names = ("camera", "rendering", "pnp", "recorder", VIEWER)
        listeners = {name: sessions(name, rogue(certificates, name)) for name in names}
        for name, bus in listeners.items():
            for topic in ALL:
                bus.subscribe(ADDRESS.key(topic, "*"), lambda key, p, at, who=name: heard.add((who, key)), 256)
            bus.hold(ADDRESS.live(name))
        sender = sessions("tracking")
        wait_for(sender, ADDRESS, names, READY_S)
        sent = [ADDRESS.key(topic, "tracking") for topic in (*role_named("tracking").writes, STATS)]
        for key in sent:
            sender.put(key, b"")
        expected = {(name, key) for name in names for key in sent if role_named(name).may("listen to", key)}
        assert until(lambda: expected <= heard), expected - heard
        assert sender.settle(READY_S)
        assert heard == expected

    def test_only_who_may_ask_is_answered(self, certificates: Path, sessions: Callable[..., ZenohBus]) -> None:
        key = ADDRESS.control("tracking")
        sessions("tracking").serve(key, lambda request: b"done")
        assert sessions(OPERATOR).ask(key, b"", READY_S).answers == {key: b"done"}
        viewer = sessions(VIEWER, rogue(certificates, VIEWER))
        assert viewer.settle(READY_S)
        with pytest.raises(TransportError, match="nobody answers"):
            viewer.ask(key, b"", 0.5)

    def test_nobody_answers_in_anothers_place(self, certificates: Path, sessions: Callable[..., ZenohBus]) -> None:
        key = ADDRESS.control("lifting")
        sessions("pnp", rogue(certificates, "pnp")).serve(key, lambda request: b"trust me")
        operator = sessions(OPERATOR)
        assert operator.settle(READY_S)
        with pytest.raises(TransportError, match="nobody answers"):
            operator.ask(key, b"", 0.5)

    def test_a_wrong_role_is_one_clear_line_at_its_own_end(self, sessions: Callable[..., ZenohBus]) -> None:
        viewer = sessions(VIEWER)
        with pytest.raises(TransportError) as refused:
            viewer.put(ADDRESS.key(GUESS), b"")
        assert str(refused.value) == (
            "refused: the role viewer may not send on test/track/mug/cam/guess; that takes a certificate of tracking"
        )
        with pytest.raises(TransportError, match=r"may not ask at .*; that takes a certificate of operator, program"):
            viewer.ask(ADDRESS.control("tracking"), b"", 1.0)
        with pytest.raises(TransportError, match=r"camera may not listen to .*/view; that takes"):
            sessions("camera").subscribe(ADDRESS.key(VIEW), lambda key, payload, at: None, 8)

    def test_and_one_at_the_hub(self, hub: Hub, certificates: Path, sessions: Callable[..., ZenohBus]) -> None:
        viewer = sessions(VIEWER, rogue(certificates, VIEWER))
        with pytest.raises(TransportError):
            viewer.ask(ADDRESS.control("retrieval"), b"", 0.3)
        line = hub.says("control/mug/cam/retrieval")
        assert "refused what a process of the role viewer tried: query test/control/mug/cam/retrieval" in line


def refused(hub: str, access: Access | None, timeout_s: float = READY_S) -> str:
    """The line that a client is given."""
    way = Joint(hub, access)
    bus = way.session()
    try:
        with pytest.raises(TransportError) as raised:
            way.wait(bus, timeout_s)
        return str(raised.value)
    finally:
        bus.close()


class TestRefused:
    """One clear line at both ends each."""

    def test_another_ca(self, hub: Hub, tmp_path: Path) -> None:
        make_certificates(tmp_path, [VIEWER], valid=DAY)
        assert "has a certificate of another CA than" in refused(hub.address, access_as(tmp_path, VIEWER))
        assert "refused a connection: it trusts another CA than ours" in hub.says("trusts another CA")

    def test_a_certificate_of_another_ca_by_one_who_trusts_ours(
        self, hub: Hub, certificates: Path, tmp_path: Path
    ) -> None:
        make_certificates(tmp_path, [VIEWER], valid=DAY)
        (tmp_path / "ca.pem").write_bytes((certificates / "ca.pem").read_bytes())
        assert "its certificates are of another CA than" in refused(hub.address, access_as(tmp_path, VIEWER))
        assert "refused a connection: a certificate of another CA" in hub.says("a certificate of another CA")

    def test_a_certificate_that_has_expired(self, tmp_path: Path) -> None:
        make_certificates(tmp_path, [HUB, VIEWER], valid=DAY, begins=datetime.now(UTC) - 2 * DAY)
        with pytest.raises(TransportError, match=r"ca\.pem: expired on .*make new certificates with"):
            access_as(tmp_path, VIEWER)

    def test_one_that_tries_it_nevertheless(self, tmp_path: Path) -> None:
        now, expired = datetime.now(UTC), tmp_path / "expired"
        expired.mkdir()
        authority = Authority.new(("localhost",), now - 3 * DAY, now + DAY)
        for folder, until in ((tmp_path, now + DAY), (expired, now - DAY)):
            authority.write(folder)
            for name in (HUB, VIEWER):
                authority.write_role(folder, name, now - 2 * DAY, until)
        with pytest.raises(TransportError, match=r"viewer\.pem: expired on"):
            access_as(expired, VIEWER)
        with a_hub(tmp_path) as hub:
            said = refused(hub.address, Access(expired, role_named(VIEWER), roles()))
            assert "viewer.pem has expired; make new ones with `fieldpose certs`" in said
            hub.says("refused a connection: a certificate that has expired")

    def test_none_at_all(self, hub: Hub) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        port = int(hub.address.rpartition(":")[2])
        with (
            socket.create_connection(("127.0.0.1", port), READY_S) as plain,
            context.wrap_socket(plain) as link,
        ):
            link.settimeout(READY_S)
            with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
                link.recv(1)
        hub.says("refused a connection: no certificate")

    def test_no_tls(self, hub: Hub) -> None:
        said = refused(hub.address.replace("tls/", "tcp/"), None)
        assert said.startswith("refused: the hub at tcp/127.0.0.1:")
        assert "is closed, and none of your runs on this machine is there" in said
        hub.says("refused a connection: it speaks no TLS")

    def test_tls_where_the_hub_is_open(self, certificates: Path) -> None:
        address = f"tcp/127.0.0.1:{free_port()}"
        with a_hub(certificates, "--open", address=address), joined(address, Entry(open=True), (), READY_S):
            said = refused(with_scheme(address, "tls"), access_as(certificates, VIEWER), 2.0)
            assert "one that is open is joined with --open" in said

    def test_an_open_hub_is_joined_by_those_who_ask_for_that_alone(self, certificates: Path) -> None:
        address = f"tcp/127.0.0.1:{free_port()}"
        said = r"is of no run of yours, .* speaks no TLS: .* joined with --open"
        with (
            a_hub(certificates, "--open", address=address),
            joined(address, Entry(open=True), (), READY_S),
            pytest.raises(TransportError, match=said),
        ):
            joint(address, Entry(), (VIEWER,))

    def test_a_key_that_cannot_be_read_is_told_by_name(self, certificates: Path, tmp_path: Path) -> None:
        folder = shutil.copytree(certificates, tmp_path / "certs")
        key_of(folder, VIEWER).unlink()
        key_of(folder, VIEWER).mkdir()
        with pytest.raises(TransportError, match=rf"{VIEWER}\.key: cannot be read: Is a directory"):
            access_as(folder, VIEWER)

    def test_a_stranger_neither_reads_nor_writes(self, hub: Hub, sessions: Callable[..., ZenohBus]) -> None:
        """Neither at the hub nor at a peer, whose own address it knows."""
        heard: list[bytes] = []
        tracking, viewer = sessions("tracking"), sessions(VIEWER)
        viewer.subscribe(ADDRESS.key(GUESS), lambda key, payload, at: heard.append(payload), 64)
        viewer.hold(ADDRESS.live(VIEWER))
        wait_for(tracking, ADDRESS, [VIEWER], READY_S)
        listening = {c.laddr.port for c in psutil.Process().net_connections("tcp") if c.status == "LISTEN"}
        assert len(listening) >= 2, "each peer listens as well"
        for port in (int(hub.address.rpartition(":")[2]), *listening):
            stolen: list[bytes] = []
            stranger = ZenohBus(f"tcp/127.0.0.1:{port}")
            try:
                for key in (ADDRESS.key(GUESS), "**"):
                    stranger._session.declare_subscriber(key, partial(_note, stolen))
                for _ in range(5):
                    tracking.put(ADDRESS.key(GUESS), b"true")
                    stranger._session.put(ADDRESS.key(GUESS), b"evil")
                    time.sleep(0.05)
                assert not stranger._session.info.routers_zid()
                assert not stranger._session.info.peers_zid()
                assert set(stolen) <= {b"evil"}
            finally:
                stranger.close()
        assert set(heard) == {b"true"}


def _note(into: list[bytes], sample: Any) -> None:
    into.append(sample.payload.to_bytes())


class TestKeysOfARun:
    @pytest.fixture(autouse=True)
    def base(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        # Runs of the same user may be up meanwhile.
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        return tmp_path / "fieldpose"

    def test_they_are_found_by_the_port_while_the_hub_lasts_and_nobody_else_can_read_them(self, base: Path) -> None:
        with run_keys.keys_for(4711) as folder:
            assert run_keys.keys_of(4711) == folder
            assert run_keys.keys_of(4712) is None
            assert {path.stat().st_mode & 0o777 for path in (base, folder)} == {0o700}
            keys = [key_of(folder, name) for name in NAMES]
            assert {path.stat().st_mode & 0o777 for path in keys} == {0o600}
            assert all(access_as(folder, name) for name in NAMES)
        assert run_keys.keys_of(4711) is None
        assert not list(base.iterdir())

    def test_a_port_is_that_of_one_run(self) -> None:
        one, another = run_keys.keys_for(4711), run_keys.keys_for(4711)
        with one, pytest.raises(TransportError, match="port 4711 is that of another run"), another:
            pass

    def test_what_a_killed_run_has_left_is_not_used_and_goes(self, base: Path) -> None:
        with run_keys.keys_for(4711) as folder:
            assert run_keys.all_keys() == [run_keys.RunKeys(4711, folder, os.getpid())]
            shutil.copytree(folder, base / "hub-4713")
            assert run_keys.keys_of(4713) is None
            with run_keys.keys_for(4712):
                assert {path.name for path in base.iterdir()} == {"hub-4711", "hub-4712"}

    @pytest.mark.parametrize("kind", ["open to others", "a link"])
    def test_a_folder_that_others_can_enter_is_not_used(self, kind: str, base: Path, tmp_path: Path) -> None:
        if kind == "a link":
            (tmp_path / "elsewhere").mkdir(mode=0o700)
            base.symlink_to(tmp_path / "elsewhere")
        else:
            base.mkdir(mode=0o755)
        with pytest.raises(FieldposeError, match="is no folder that you alone can enter"), run_keys.keys_for(4711):
            pass
        assert run_keys.all_keys() == []

    def test_a_hub_of_this_machine_is_closed_and_joined_without_a_word(self, tmp_path: Path) -> None:
        port = free_port()
        hub = f"tcp/127.0.0.1:{port}"
        with subprocess.Popen(command("stage", "hub", "--listen", hub), stderr=subprocess.PIPE) as process:
            try:
                assert until(lambda: run_keys.keys_of(port) is not None, READY_S)
                with joined(hub, Entry(), (VIEWER,), READY_S) as bus:
                    assert bus.live("test/live/*/*/*") == set()
            finally:
                process.terminate()
        assert run_keys.keys_of(port) is None

    def test_an_address_that_is_closed_and_nobodys_is_one_line(self) -> None:
        with pytest.raises(TransportError, match=r"tls/127\.0\.0\.1:4711 is closed, and this user has no keys for it"):
            joint("tls/127.0.0.1:4711", Entry(), (VIEWER,))


class TestOpenToOthers:
    @pytest.mark.parametrize("listen", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tls/0.0.0.0:7447", "udp/0.0.0.0:7447"])
    def test_an_address_that_others_reach_is_refused_unless_one_says_so(self, listen: str) -> None:
        with (
            pytest.raises(UsageError, match=r"can be reached by other hosts.*--tls DIR.* or --open"),
            hub_keys(listen, Entry()),
        ):
            pass

    def test_open_is_open_and_without_tls(self) -> None:
        with hub_keys("tcp/0.0.0.0:7447", Entry(open=True)) as made:
            assert made == ("tcp/0.0.0.0:7447", None)
        with pytest.raises(UsageError, match="write tcp/ instead"), hub_keys("tls/0.0.0.0:7447", Entry(open=True)):
            pass

    def test_a_client_of_another_host_says_which(self) -> None:
        with pytest.raises(UsageError, match=r"tcp/robot:7447 is of another host: give --tls DIR.* or --open"):
            joint("tcp/robot:7447", Entry(), (VIEWER,))
        assert joint("tcp/robot:7447", Entry(open=True), (VIEWER,)).access is None

    def test_both_ways_exclude_each_other(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="exclude each other"):
            joint("tcp/robot:7447", Entry(tmp_path, True), (VIEWER,))

    def test_a_folder_without_the_role_says_what_there_is(self, tmp_path: Path) -> None:
        make_certificates(tmp_path, ["camera"], valid=DAY)
        with pytest.raises(TransportError, match=r"of the role operator or viewer; there are those of: camera"):
            joint("tcp/robot:7447", Entry(tmp_path), (OPERATOR, VIEWER))


class TestRefusals:
    def test_reasons_in_words(self) -> None:
        assert link_reason("invalid peer certificate: Expired. Hint: increase the limit.").endswith("has expired")
        assert link_reason("something new. Hint: increase the system open file limit.") == "something new"

    def test_each_kind_is_said_once_and_counted(self) -> None:
        said: list[str] = []
        refusals = Refusals(said.append)
        line = "2026 \x1b[33m WARN\x1b[0m acc-0 zenoh_link_tls::unicast: peer sent no certificates. Hint: x."
        assert all(refusals.took(line) for _ in range(3))
        assert said == ["refused a connection: no certificate"]
        assert refusals.counts == {said[0]: 3}
        assert not refusals.took("2026 ERROR net-0 zenoh::net: something else")


def test_certificates_are_never_overwritten(certificates: Path) -> None:
    before = certificate_of(certificates, VIEWER).read_bytes()
    with pytest.raises(FieldposeError, match="is there already, and is not overwritten"):
        make_certificates(certificates, [VIEWER])
    assert certificate_of(certificates, VIEWER).read_bytes() == before


def test_the_configuration_for_other_languages_sends_frames_and_nothing_else(
    hub: Hub, certificates: Path, sessions: Callable[..., ZenohBus], tmp_path: Path
) -> None:
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8")
    block = text.split("```json5\n")[1].split("```")[0]
    # The hub's certificate is compared with its name here: Zenoh does so unless it is told not to.
    file = tmp_path / "camera.json5"
    port = hub.address.rpartition(":")[2]
    file.write_text(block.replace("certs/", f"{certificates}/").replace("robot:7447", f"localhost:{port}"))
    heard: set[str] = set()
    listener = sessions(OBSERVER)
    for topic in (FRAME, GUESS):
        listener.subscribe(ADDRESS.key(topic), lambda key, payload, at: heard.add(key), 64)
    listener.settle(READY_S)
    with zenoh.open(zenoh.Config.from_file(str(file))) as session:

        def frame_came() -> bool:
            session.put(ADDRESS.key(GUESS), b"evil")
            session.put(ADDRESS.key(FRAME), b"image")
            return bool(heard)

        assert until(frame_came)
    assert heard == {ADDRESS.key(FRAME)}


def test_doctor_says_who_listens_where_and_that_strangers_are_kept_out(hub: Hub) -> None:
    port = hub.address.rpartition(":")[2]
    (its,) = [finding for finding in listening() if f"hub {port}" in finding.detail]
    assert (its.what, its.status) == ("listening", "ok")
    assert its.detail.startswith("127.0.0.1: ")
    assert its.detail.endswith("closed by certificates")
    (tried,) = closed()
    assert (tried.what, tried.status) == ("strangers", "ok")


def test_doctor_warns_of_a_hub_that_everybody_reaches(certificates: Path) -> None:
    address = f"tcp/0.0.0.0:{free_port()}"
    entry = Entry(open=True)
    with a_hub(certificates, "--open", address=address), joined(address, entry, (), READY_S):
        (its,) = [finding for finding in listening() if f"hub {address.rpartition(':')[2]}" in finding.detail]
    assert its.status == "warning"
    assert its.detail.startswith("0.0.0.0: ")
    assert its.detail.endswith("; open")
