"""Plots over time on a page, by viser's uPlot: lines of a History, drawn anew once a second."""

from __future__ import annotations

import viser
from viser import uplot

from fieldpose.deploy.graph import AT_WORK
from fieldpose.deploy.viewing.history import Curves, History

SOLVING = tuple(name for name in AT_WORK if name != "tracking")
"""The stages that take part in a solve, in their order."""
_COLOURS = ("#1f7ae0", "#e07b18", "#18a558", "#b02a8f", "#7a5cd6", "#c0392b")


class Charts:
    """One plot under the other. ago: seconds are told as before now, as of something live, not from the beginning."""

    def __init__(self, gui: viser.GuiApi, ago: bool) -> None:
        self._ago = ago
        self._folder = gui.add_folder("over time", order=4)
        self._score = _Chart(gui, "score, 0 to 1", 0, (0.0, 1.05))
        self._latency = _Chart(gui, "from sending a frame to its state, ms", 1)
        self._stages = _Chart(gui, "each stage of a solve, ms", 2)
        self._rates = _Chart(gui, "how many a second", 3)
        self._losses = _Chart(gui, "what was lost a second", 4)

    def draw(self, history: History) -> None:
        """Draw what is known now."""
        now = history.now if self._ago else 0.0
        with self._folder:
            self._score.draw(history.scores(), now)
            self._latency.draw(history.latencies(), now)
            self._stages.draw(history.stages(SOLVING), now)
            self._rates.draw(history.rates(), now)
            self._losses.draw(history.losses(), now)


class _Chart:
    """Shown once there is a line to be drawn, and anew where its lines are others."""

    def __init__(
        self, gui: viser.GuiApi, title: str, order: float, limits: tuple[float, float] | None = None
    ) -> None:  # fmt: skip
        self._gui, self._title, self._order = gui, title, order
        self._scales = {"x": uplot.Scale(time=False)} | ({} if limits is None else {"y": uplot.Scale(range=limits)})
        self._drawn: tuple[str, ...] = ()
        self._handle: viser.GuiUplotHandle | None = None

    def draw(self, curves: Curves, now: float) -> None:
        if len(curves.seconds) < 2 or not curves.lines:
            return
        data, names = (curves.seconds - now, *curves.lines.values()), tuple(curves.lines)
        if self._handle is not None and names == self._drawn:
            self._handle.data = data
            return
        if self._handle is not None:
            self._handle.remove()
        lines = (uplot.Series(label=n, stroke=c, width=1.5) for n, c in zip(names, _COLOURS, strict=False))
        self._drawn = names
        self._handle = self._gui.add_uplot(
            data, (uplot.Series(label="s"), *lines), title=self._title, scales=self._scales, aspect=2.4,
            padding=(8, 24, 0, 0), order=self._order,
        )  # fmt: skip
