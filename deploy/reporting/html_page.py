"""One HTML page that needs nothing else: its frame, and what is put into it. All text that it is given is escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np

from fieldpose.deploy.reporting.overlay import encoded

_JPEG = Path("picture.jpg")
_STYLE = """
:root{color-scheme:light dark;--ink:#1c2733;--soft:#5d6b7a;--line:#d9e0e7;--page:#f4f6f8;--card:#fff;--bad:#b3261e}
@media (prefers-color-scheme:dark){
:root{--ink:#e3e8ee;--soft:#9aa7b4;--line:#333e49;--page:#14191e;--card:#1d242b;--bad:#ff8a80}
.plot img{filter:invert(.89) hue-rotate(180deg)}}
*{box-sizing:border-box}
body{margin:0 auto;padding:1rem;max-width:72rem;background:var(--page);color:var(--ink);
font:16px/1.5 system-ui,sans-serif;overflow-wrap:anywhere}
h1{font-size:1.5rem;line-height:1.25;margin:.5rem 0}h2{font-size:1.1rem;margin:0 0 .75rem}
p{margin:.25rem 0 .75rem}.soft{color:var(--soft)}.note{color:var(--bad);font-weight:600}
section{background:var(--card);border:1px solid var(--line);border-radius:.6rem;padding:1rem;margin:1rem 0}
img{display:block;max-width:100%;height:auto;border-radius:.3rem}
.wide{overflow-x:auto;overflow-wrap:normal}.wide td{white-space:nowrap;padding-right:1.2rem}
.plot img{min-width:40rem;width:100%}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(9rem,1fr));gap:.75rem;margin:1rem 0}
.tiles div{background:var(--card);border:1px solid var(--line);border-radius:.6rem;padding:.6rem .8rem}
.tiles b{display:block;font-size:1.35rem;line-height:1.3}.tiles span{color:var(--soft);font-size:.85rem}
.frames{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(26rem,100%),1fr));gap:1rem}
figure{margin:0}figcaption{margin-top:.4rem;font-size:.9rem}
table{border-collapse:collapse;width:100%;font-size:.92rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;vertical-align:top;padding:.3rem .6rem .3rem 0;border-top:1px solid var(--line)}
tr:first-child>*{border-top:0}tbody th{font-weight:400;color:var(--soft);width:40%}thead th{color:var(--soft)}
""".strip().replace("\n", "")


def page(kind: str, heading: str, about: Iterable[str], content: str, note: str = "") -> bytes:
    """The file: what it is of, lines about that, and content made by the functions below; it runs no script."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{escape(f"{kind}: {heading}")}</title>
<style>{_STYLE}</style>
</head>
<body>
<p class="soft">{escape(kind)}</p>
<h1>{escape(heading)}</h1>
{lines(about)}
{f'<p class="note">{escape(note)}</p>' if note else ""}
{content}
</body>
</html>
""".encode()


def section(title: str, content: str) -> str:
    """Content under a title; nothing where there is none."""
    return f"<section><h2>{escape(title)}</h2>{content}</section>\n" if content else ""


def soft(text: str) -> str:
    """A remark."""
    return f'<p class="soft">{escape(text)}</p>'


def table(named: Iterable[tuple[str, str]]) -> str:
    """Names with their values; nothing where there are none."""
    cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in named)
    return f"<table><tbody>{cells}</tbody></table>" if cells else ""


def columns(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table with a head."""
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def lines(told: Iterable[str]) -> str:
    """A paragraph of each."""
    return "".join(f"<p>{escape(line.strip())}</p>" for line in told)


def tiles(named: Iterable[tuple[str, str]]) -> str:
    """Values in large letters, each with what it is."""
    each = (f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in named)
    return f'<div class="tiles">{"".join(each)}</div>'


def gallery(figures: Iterable[str]) -> str:
    """Figures side by side, as many as there is room for."""
    return f'<div class="frames">{"".join(figures)}</div>'


def figure(pixels: np.ndarray | None, named: str, told: str) -> str:
    """A picture (h, w, 3) uint8 RGB, where there is one, over its name and what is told of it."""
    picture = "" if pixels is None else _picture(encoded(pixels, _JPEG), "jpeg", named)
    return f"<figure>{picture}<figcaption><b>{escape(named)}</b>{escape(told)}</figcaption></figure>"


def plot(content: bytes, told: str) -> str:
    """A png that is wide; told: for those who do not see it."""
    return f'<div class="wide plot">{_picture(content, "png", told)}</div>'


def _picture(content: bytes, kind: str, told: str) -> str:
    data = base64.b64encode(content).decode()
    return f'<img alt="{escape(told)}" src="data:image/{kind};base64,{data}">'
