"""How far the track is trusted: the four states, and what leads from one to another."""

from __future__ import annotations

from fieldpose.bus.messages import TrackingState


class Trust:
    """INITIALIZING or LOST until a pose is accepted, TRACKING while good ones come, LIMITED while they do not.

    A rejected pose is one strike, an accepted weak one a part of it, a good one takes all back. One strike limits
    tracking and `lost_after` lose it; while initializing, `patience` do. `epoch` changes with each loss and
    recovery, so that what was under way before is not held against the track after.
    """

    def __init__(self, lost_after: int, weak_after: int, patience: int) -> None:
        self.state = TrackingState.INITIALIZING
        self.epoch = 0
        self._lost_after = lost_after
        self._weak_strike = lost_after / weak_after
        self._patience = patience
        self._strikes = 0.0

    @property
    def tracked(self) -> bool:
        return self.state in (TrackingState.TRACKING, TrackingState.LIMITED)

    def good(self) -> None:
        """A good pose was accepted."""
        self._recover()
        self._strikes = 0.0
        self.state = TrackingState.TRACKING

    def weak(self) -> None:
        """A weak pose was accepted."""
        if not self.tracked:
            self._recover()
            self._strikes = 1.0
            self.state = TrackingState.LIMITED
        else:
            self._strike(self._weak_strike)

    def rejected(self) -> None:
        """A frame gave no pose, or one that is not believed."""
        self._strike(1.0)

    def lost(self) -> None:
        """What was believed has turned out to be wrong."""
        if self.tracked:
            self.state = TrackingState.LOST
            self.epoch += 1

    def stale(self) -> None:
        """Nothing has been heard for long."""
        if self.state is TrackingState.TRACKING:
            self._strikes = max(self._strikes, 1.0)
            self.state = TrackingState.LIMITED

    def _recover(self) -> None:
        self.epoch += not self.tracked

    def _strike(self, weight: float) -> None:
        self._strikes += weight
        if self.tracked and self._strikes >= 1.0:
            self.state = TrackingState.LIMITED
        limit = self._patience if self.state is TrackingState.INITIALIZING else self._lost_after
        if self.state is not TrackingState.LOST and self._strikes >= limit:
            self.state = TrackingState.LOST
            self.epoch += 1
