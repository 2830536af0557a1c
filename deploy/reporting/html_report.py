"""A run as one HTML page that needs nothing else: figures in, the file's bytes out."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from fieldpose.deploy.evaluation.scores import DIMENSIONS, coverage
from fieldpose.deploy.reporting.overlay import encoded
from fieldpose.deploy.reporting.report import STAGE_COLUMNS, STAGES_TITLE, rows, stage_rows
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.deploy.reporting.timeline import file_of, timeline
from fieldpose.deploy.reporting.worst import Bad, squared_distances
from fieldpose.stages.tracking.scoring import deviations

_FOUND, _SAID = "#1f4e79", "#e08214"
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
.wide{overflow-x:auto}.plot img{min-width:40rem;width:100%}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(9rem,1fr));gap:.75rem;margin:1rem 0}
.tiles div{background:var(--card);border:1px solid var(--line);border-radius:.6rem;padding:.6rem .8rem}
.tiles b{display:block;font-size:1.35rem;line-height:1.3}.tiles span{color:var(--soft);font-size:.85rem}
.frames{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(26rem,100%),1fr));gap:1rem}
figure{margin:0}figcaption{margin-top:.4rem;font-size:.9rem}
table{border-collapse:collapse;width:100%;font-size:.92rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;vertical-align:top;padding:.3rem .6rem .3rem 0;border-top:1px solid var(--line)}
tr:first-child>*{border-top:0}tbody th{font-weight:400;color:var(--soft);width:40%}thead th{color:var(--soft)}
""".strip().replace("\n", "")


@dataclass(frozen=True)
class Report:
    """What a page tells of one pipeline's run.

    summary: as of `summarise`. live: see `timeline`. worst: each with its picture (h, w, 3) uint8 RGB, None where there
    is none. settings: those that are not the defaults. decided: what was left open, and what was made of it. made_with:
    the machine and versions. field_lines: what the field says of itself.
    """

    source: str
    field_name: str
    summary: Mapping[str, Any]
    frames: Sequence[FrameResult] = ()
    live: bool = True
    interrupted: bool = False
    worst: Sequence[tuple[Bad, np.ndarray | None]] = ()
    field_lines: Sequence[str] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    decided: Mapping[str, str] = field(default_factory=dict)
    made_with: Mapping[str, str] = field(default_factory=dict)


def html(report: Report) -> bytes:
    """The page. Everything in it is text or a picture: it runs no script and asks nothing from anywhere."""
    title = escape(f"{report.source} by {report.field_name}")
    sections = [
        _section("Over time", _timeline(report)),
        _section("The frames that went worst", _worst(report)),
        _section("Figures", _table(rows(report.summary))),
        _section(STAGES_TITLE.capitalize(), _columns(STAGE_COLUMNS, stage_rows(report.summary))),
        _section("How true the stated covariances are", _covariances(report.frames)),
        _section("The field", "".join(f"<p>{escape(line.strip())}</p>" for line in report.field_lines)),
        _section("What was decided", _table(report.decided.items())),
        _section(
            "Settings that are not the defaults, once all is decided", _table(report.settings.items()) or _soft("none")
        ),
        _section("Made with", _table(report.made_with.items())),
    ]
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{title}</title>
<style>{_STYLE}</style>
</head>
<body>
<p class="soft">fieldpose run</p>
<h1>{escape(report.source)}</h1>
<p>looked for with {escape(report.field_name)}</p>
{'<p class="note">The run was interrupted before its source had ended.</p>' if report.interrupted else ""}
{_tiles(report.summary)}
{"".join(sections)}
</body>
</html>
""".encode()


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>\n" if content else ""


def _soft(text: str) -> str:
    return f'<p class="soft">{escape(text)}</p>'


def _table(named: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in named)
    return f"<table><tbody>{cells}</tbody></table>" if cells else ""


def _columns(headings: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in line)}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _tiles(summary: Mapping[str, Any]) -> str:
    frames, found = summary["frames"], summary["poses_ok"]
    tiles = [(f"{found / frames:.1%}" if frames else "-", f"of {frames} frames have a pose")]
    for key, unit, what in (
        ("rotation_error_deg", "°", "rotation error, median"),
        ("translation_error", "", "translation error, median, units"),
    ):
        if summary[key] is not None:
            tiles.append((f"{summary[key]['median']:.3g}{unit}", what))
    latency = summary["latency_ms"]["p50"]
    tiles.append(("-" if latency is None else f"{latency:.0f} ms", "latency, median"))
    tiles.append((f"{summary['rate_hz']:.1f}", "frames a second"))
    tiles.append((str(summary["dropped_at_the_door"]), "frames dropped at the door"))
    return (
        f'<div class="tiles">{"".join(f"<div><b>{value}</b><span>{what}</span></div>" for value, what in tiles)}</div>'
    )


def _timeline(report: Report) -> str:
    if not report.frames:
        return _soft("no frame has come")
    return _plot(timeline(report.frames, "png", report.source, report.live), "Errors, scores and latencies over time")


def _worst(report: Report) -> str:
    if not report.worst:
        return _soft("none: no frame was worked on")
    started_ns = report.frames[0].capture_ns if report.frames else 0
    return f'<div class="frames">{"".join(_frame(bad, pixels, started_ns) for bad, pixels in report.worst)}</div>'


def _frame(bad: Bad, pixels: np.ndarray | None, started_ns: int) -> str:
    named = f"frame {bad.result.frame_id}, {(bad.result.capture_ns - started_ns) / 1e9:.2f} s"
    row = f" ({bad.in_a_row} in a row)" if bad.in_a_row > 1 else ""
    picture = "" if pixels is None else _picture(encoded(pixels, _JPEG), "jpeg", named)
    return f"<figure>{picture}<figcaption><b>{escape(named)}</b>{row}: {escape(bad.why)}</figcaption></figure>"


def _picture(content: bytes, kind: str, told: str) -> str:
    data = base64.b64encode(content).decode()
    return f'<img alt="{escape(told)}" src="data:image/{kind};base64,{data}">'


def _plot(content: bytes, told: str) -> str:
    return f'<div class="wide plot">{_picture(content, "png", told)}</div>'


def _covariances(frames: Sequence[FrameResult]) -> str:
    squared = squared_distances(frames)
    inside = coverage(squared)
    if inside is None:
        return ""
    lines = [(f"{percent} %", f"{share * len(squared):.0f} of {len(squared)}", f"{share:.1%}") for percent, share in
             inside.items()]  # fmt: skip
    table = _columns(("region", "true poses inside it", "share"), lines)
    return table + _plot(
        _drawn_covariances(frames, squared), "Errors and their stated deviations; true poses by region"
    )


def _drawn_covariances(frames: Sequence[FrameResult], squared: Sequence[float]) -> bytes:
    """Each error with its stated standard deviation over time, and the share of true poses inside each region."""
    known = [frame for frame in frames if frame.errors is not None and frame.covariance is not None]
    at = [(frame.capture_ns - frames[0].capture_ns) / 1e9 for frame in known]
    errors = np.array([frame.errors for frame in known])
    said = np.array([deviations(frame.covariance) for frame in known if frame.covariance is not None])[:, ::-1]
    drawing = Figure(figsize=(11.0, 4.2), layout="constrained")
    axes = drawing.subplot_mosaic([["turn", "regions"], ["shift", "regions"]], width_ratios=(3, 2))
    above, below, axis = axes["turn"], axes["shift"], axes["regions"]
    for part, which, label in ((above, 0, "rotation,\ndegrees"), (below, 1, "translation,\nunits")):
        part.semilogy(at, errors[:, which], ".", color=_FOUND, markersize=4, label="error")
        part.semilogy(at, said[:, which], "-", color=_SAID, linewidth=1, label="stated standard deviation")
        _framed(part, "", label)
    below.set_xlabel("seconds since the first frame")
    above.legend(fontsize=8, loc="upper right")
    regions = np.linspace(0, 1, 101)
    axis.plot([0, 1], [0, 1], "--", color="black", linewidth=0.8, label="as stated")
    axis.plot(
        regions, [np.mean(np.array(squared) <= limit) for limit in chi2.ppf(regions, DIMENSIONS)], color=_FOUND,
        label="found",
    )  # fmt: skip
    _framed(axis, "probability of the region", "share of true poses inside")
    axis.legend(fontsize=8, loc="upper left")
    return file_of(drawing, "png")


def _framed(axis: Axes, x_label: str, y_label: str) -> None:
    axis.set_xlabel(x_label, fontsize=9)
    axis.set_ylabel(y_label, fontsize=9)
    axis.grid(visible=True, alpha=0.35)
