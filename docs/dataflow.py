"""Draw docs/dataflow.svg: the processes and the topics between them."""

from __future__ import annotations

from pathlib import Path

BOXES = {
    "camera": (20, 150), "tracking": (200, 150), "rendering": (360, 30), "matching": (520, 30), "lifting": (700, 30),
    "pnp": (700, 260), "refinement": (430, 260), "retrieval": (200, 30),
}  # fmt: skip
ARROWS = [
    ("camera", "tracking", "frame"), ("tracking", "rendering", "guess"), ("rendering", "matching", "view"),
    ("matching", "lifting", "matches"), ("lifting", "pnp", "correspondences"), ("pnp", "refinement", "estimate"),
    ("refinement", "tracking", "pose"), ("camera", "retrieval", "frame"), ("retrieval", "tracking", "retrieved"),
]  # fmt: skip
WIDTH, HEIGHT = 120, 50
FIELD = {"rendering", "lifting", "refinement"}


def anchor(name: str, towards: str) -> tuple[float, float]:
    """The point of a box's border that faces another box."""
    (x, y), (u, v) = BOXES[name], BOXES[towards]
    if abs(u - x) < 5:
        return x + WIDTH / 2, y + (HEIGHT if v > y else 0)
    return x + (WIDTH if u > x else 0), y + HEIGHT / 2


def draw() -> str:
    """The picture as SVG."""
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 840 400" font-family="sans-serif" font-size="15">',
        '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#456"/></marker></defs><rect width="840" height="400" fill="#fff"/>',
    ]
    for source, target, topic in ARROWS:
        (x0, y0), (x1, y1) = anchor(source, target), anchor(target, source)
        parts.append(f'<path d="M{x0} {y0}L{x1} {y1}" stroke="#456" stroke-width="2" marker-end="url(#a)"/>')
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        label_y = y + 5 if x0 == x1 else y - 9
        place = f'<text x="{x}" y="{label_y}" text-anchor="middle" font-size="12"'
        parts.append(f'{place} stroke="#fff" stroke-width="5">{topic}</text>{place} fill="#234">{topic}</text>')
    for name, (x, y) in BOXES.items():
        fill = "#ffe3b8" if name in FIELD else "#dcebf7"
        parts.append(f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="{fill}" stroke="#456"/>')
        parts.append(f'<text x="{x + WIDTH / 2}" y="{y + 31}" text-anchor="middle" fill="#123">{name}</text>')
    parts.append('<rect x="20" y="330" width="800" height="34" rx="8" fill="#eef1f4" stroke="#9ab"/>')
    parts.append(
        '<text x="420" y="352" text-anchor="middle" fill="#345">Zenoh bus: every box is a process, every arrow a '
        "topic; the MCAP recorder takes all of them</text>"
    )
    parts.append('<text x="20" y="390" font-size="12" fill="#754">orange: renders the radiance field</text></svg>')
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")
