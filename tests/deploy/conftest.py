"""What tests of commands share."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from fieldpose.bus.transport import serve_hub
from fieldpose.deploy.processes.endpoints import free_port


@pytest.fixture
def hub() -> Iterator[str]:
    """The address of an open hub in this process."""
    stop, address = threading.Event(), f"tcp/127.0.0.1:{free_port()}"
    serving = threading.Thread(target=serve_hub, args=(address, None, stop))
    serving.start()
    yield address
    stop.set()
    serving.join()
