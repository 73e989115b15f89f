"""The result page: one HTML document that needs nothing from outside."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files

from naibu.viewer.result_page.figures import residual_panels, rms_bars
from naibu.viewer.result_page.packing import packed_scenes
from naibu.viewer.result_page.payload import Report, ResidualSet, Scene
from naibu.viewer.result_page.tables import correlation_table, parameter_table, plain_table, provenance_table

# The page may run its own script and style and nothing else: no request leaves the reader's machine.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def asset(name: str) -> str:
    """Return a file of the bundle that ``viewer-src`` builds, safe to stand inside a script or style element."""
    text = (files("naibu.viewer") / "assets" / name).read_text(encoding="utf-8")
    return text.replace("</script", r"<\/script").replace("</style", r"<\/style").replace("<!--", r"<\!--")


def document(report: Report, scenes: Sequence[Scene]) -> str:
    """Return the page of `report`; the 3-D view shows `scenes`, usually those of the report."""
    sections = _sections(report)
    links = "".join(f'<li><a href="#{key}">{escape(title)}</a></li>' for key, title, _ in sections)
    body = "".join(_section(key, title, inner) for key, title, inner in sections)
    data = _scene_data(scenes) if scenes else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">'
        f'<title>{escape(report.title)}</title><link rel="icon" href="data:,"><style>{asset("report.css")}</style></head>\n'
        f'<body><header><h1>{escape(report.title)}</h1>{_headline(report)}<nav aria-label="Contents"><ul>{links}</ul></nav></header>\n'
        f"<main>{body}</main>\n<footer>Lengths in mm, pressures and moduli in kPa, forces in mN. This page is complete in itself: it loads "
        f"nothing from the network.</footer>\n{data}</body></html>\n"
    )


def _scene_data(scenes: Sequence[Scene]) -> str:
    data = f'<script type="application/gzip+base64" id="naibu-scenes">{packed_scenes(scenes)}</script>'
    return f"{data}<script>{asset('report.js')}</script>"


def _headline(report: Report) -> str:
    sentences = "".join(f"<p{' class=lead' if i == 0 else ''}>{escape(s)}</p>" for i, s in enumerate(report.headline))
    return sentences + rms_bars(report.scenes)


def _section(key: str, title: str, inner: str) -> str:
    if key == "provenance":
        return f'<section id="{key}"><details><summary>{escape(title)}</summary>{inner}</details></section>\n'
    return f'<section id="{key}" class="long" aria-labelledby="h-{key}"><h2 id="h-{key}">{escape(title)}</h2>{inner}</section>\n'


def _sections(report: Report) -> list[tuple[str, str, str]]:
    """Return key, title and inner HTML of what the report has, in reading order."""
    found = [
        ("view", "Predicted and measured markers in 3-D", _viewer() if report.scenes else ""),
        ("accuracy", "Accuracy", plain_table(report.accuracy) if report.accuracy else ""),
        ("residuals", "Residuals by marker layer", _residuals(report.residuals)),
        ("parameters", "Parameters", _parameters(report)),
        ("limits", "What the data cannot tell", _limits(report.undetermined)),
        ("tables", "Further tables", "".join(plain_table(t) for t in report.tables)),
        ("provenance", "How this was computed", provenance_table(report.provenance) if report.provenance else ""),
    ]
    return [entry for entry in found if entry[2]]


def _viewer() -> str:
    return (
        '<div id="naibu-viewer"></div>'
        '<noscript><p class="no-3d">The 3-D view needs JavaScript; everything else on this page is complete without it.</p></noscript>'
    )


def _residuals(sets: Sequence[ResidualSet]) -> str:
    plots = "".join(residual_panels(s) for s in sets)
    if not plots:
        return ""
    key = (
        "Predicted minus measured, along each axis. Each dot is a marker, the upright stroke is the layer's median; the lowest layer "
        "is at the bottom. The grey band is twice the noise's standard deviation: noise alone leaves 95 % of the dots inside."
    )
    return f'<p class="note">{key}</p>{plots}'


def _parameters(report: Report) -> str:
    out = ""
    if report.parameters:
        key = "Circle: estimate. Line: 95 % interval; an arrowhead or “?” marks a side that the data do not bound."
        out += parameter_table(report.parameters) + f'<p class="note">{key}</p>'
    if report.correlation is not None:
        key = "Near ±1 only a combination of the two parameters is known, not each one by itself. Column numbers are those of the rows."
        out += f'<h3>Correlation of the estimates</h3><p class="note">{key}</p>{correlation_table(report.correlation)}'
    return out


def _limits(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return f'<div class="limits"><ul>{"".join(f"<li>{escape(s)}</li>" for s in sentences)}</ul></div>'
