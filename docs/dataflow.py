"""Draw docs/dataflow.svg from the graph: every process, and every topic from who writes it to each who reads it."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from fieldpose.deploy.graph import GRAPH, HUB, RECORDER

LEFT, TOP, ROW, WIDTH, HEIGHT, LANE = 20, 46, 64, 118, 38, 62
PROCESSES = [row for row in GRAPH if row.name not in (HUB, RECORDER)]
COLOURS = ("#1b6ca8", "#b3541e", "#2e7d32", "#7b3fa0", "#a8325e", "#3b6e75", "#8a6d00", "#4a4e9c")


def edges() -> list[tuple[str, str, str]]:
    """Every (writer, reader, topic), without the recorder, who reads all."""
    return [
        (writer.name, reader.name, topic.name)
        for writer in PROCESSES for topic in writer.writes for reader in PROCESSES if topic in reader.reads
    ]  # fmt: skip


def draw() -> str:
    """The picture as SVG: processes from top to bottom, a line of its own for each topic, dots where it is read."""
    place = {row.name: TOP + i * ROW for i, row in enumerate(PROCESSES)}
    topics = list(dict.fromkeys(topic for _, _, topic in edges()))
    width = LEFT + WIDTH + LANE * (len(topics) + 1) + 10
    bottom = TOP + len(PROCESSES) * ROW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom + 64}" font-family="sans-serif"'
        f' font-size="13"><rect width="{width}" height="{bottom + 64}" fill="#fff"/>'
    ]
    by_topic = {topic: list(those) for topic, those in groupby(sorted(edges(), key=_topic), key=_topic)}
    drawn = [
        _topic_line(topic, by_topic[topic], place, LEFT + WIDTH + LANE * (lane + 1), COLOURS[lane % len(COLOURS)])
        for lane, topic in enumerate(topics)
    ]
    parts += [part for branches, _ in drawn for part in branches] + [part for _, line in drawn for part in line]
    for row in PROCESSES:
        fill, y = "#ffe3b8" if row.renders else "#dcebf7", place[row.name]
        parts.append(f'<rect x="{LEFT}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="{fill}" stroke="#456"/>')
        parts.append(f'<text x="{LEFT + WIDTH / 2}" y="{y + 24}" text-anchor="middle" fill="#123">{row.name}</text>')
    parts.append(
        f'<rect x="{LEFT}" y="{bottom + 2}" width="{width - 2 * LEFT}" height="28" rx="8" fill="#eef1f4"/>'
        f'<text x="{width / 2}" y="{bottom + 21}" text-anchor="middle" fill="#345">Zenoh bus: every box is a process, '
        "every line a topic; the MCAP recorder takes all of them, and every process's stats</text>"
    )
    parts.append(
        f'<text x="{LEFT}" y="{bottom + 50}" font-size="12" fill="#754">orange: renders the radiance field; a circle '
        "writes, a dot reads; perturbation runs where guesses are made from the truth</text></svg>"
    )
    return "\n".join(parts) + "\n"


def _topic(edge: tuple[str, str, str]) -> str:
    return edge[2]


def _topic_line(
    topic: str, those: list[tuple[str, str, str]], place: dict[str, int], x: int, colour: str
) -> tuple[list[str], list[str]]:
    """The branches to a topic's processes, and its line from the first to the last of them, with its name."""
    writers, readers = (sorted({edge[side] for edge in those}, key=place.__getitem__) for side in (0, 1))
    up, down = 12, 26
    ends = [place[name] + up for name in writers] + [place[name] + down for name in readers]
    branches: list[str] = []
    parts = [f'<path d="M{x} {min(ends)}V{max(ends)}" stroke="{colour}" stroke-width="2"/>']
    for name in writers:
        y = place[name] + up
        branches.append(f'<path d="M{LEFT + WIDTH} {y}H{x}" stroke="#b4bec8" stroke-width="1.5"/>')
        parts.append(f'<circle cx="{x}" cy="{y}" r="4" fill="#fff" stroke="{colour}" stroke-width="2"/>')
    for name in readers:
        y = place[name] + down
        branches.append(
            f'<path d="M{LEFT + WIDTH} {y}H{x}" stroke="#b4bec8" stroke-width="1.5" stroke-dasharray="5 3"/>'
        )
        parts.append(f'<circle cx="{x}" cy="{y}" r="4" fill="{colour}"/>')
    label_y = 18 + 16 * (((x - LEFT - WIDTH) // LANE) % 2)
    parts.append(f'<path d="M{x} {label_y + 4}V{min(ends)}" stroke="{colour}" stroke-dasharray="1 4"/>')
    parts.append(f'<text x="{x}" y="{label_y}" text-anchor="middle" font-size="12" fill="{colour}">{topic}</text>')
    return branches, parts


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")
