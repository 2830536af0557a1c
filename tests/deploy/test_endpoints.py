"""Addresses: who listens where, and ports that are taken."""

from __future__ import annotations

import socket

import pytest

from fieldpose.deploy.processes.endpoints import check_free, free_port, is_local, peer_address
from fieldpose.errors import TransportError


@pytest.mark.parametrize("hub", ["tcp/127.0.0.1:7447", "tcp/localhost:1", "tls/[::1]:7447"])
def test_around_a_hub_of_this_machine_nobody_listens_to_others(hub: str) -> None:
    assert peer_address(hub) == hub[:3] + "/127.0.0.1:0"
    assert is_local(hub)


@pytest.mark.parametrize("hub", ["tcp/robot:7447", "tcp/10.0.0.2:7447", "tcp/0.0.0.0:7447"])
def test_around_a_hub_for_others_everybody_can_be_reached(hub: str) -> None:
    assert peer_address(hub) == "tcp/0.0.0.0:0"
    assert not is_local(hub)


def test_a_port_is_free_until_someone_listens() -> None:
    port = free_port()
    check_free(f"tcp/127.0.0.1:{port}")
    check_free(None)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        with pytest.raises(TransportError, match="the port is in use"):
            check_free(f"tcp/127.0.0.1:{port}")
    with pytest.raises(TransportError, match=r"cannot listen on .*99999"):
        check_free("tcp/127.0.0.1:99999")


def test_a_free_port_of_the_sixth_version_is_no_error() -> None:
    check_free(f"tcp/[::1]:{free_port()}")
