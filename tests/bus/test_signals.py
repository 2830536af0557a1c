"""Signals as a wish to stop."""

from __future__ import annotations

import os
import signal

from fieldpose.bus.signals import StopSignals


def test_a_second_signal_is_told_from_the_first() -> None:
    with StopSignals() as signals:
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.stop.wait(10.0)
        assert not signals.again.is_set()
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.again.wait(10.0)
