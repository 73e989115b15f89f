"""Sections of the result page as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from naibu.viewer.cards import cards_html
from naibu.viewer.marker_view import SCRIPT, MarkerView
from naibu.viewer.page_frame import page_html
from naibu.viewer.result_page.estimates import correlation_table, parameter_cards, parameter_table
from naibu.viewer.result_page.figures import residual_panels, rms_bars
from naibu.viewer.result_page.payload import Report, ResidualSet, Scene, VerdictNote
from naibu.viewer.tables import provenance_section, table_html


def document(report: Report, scenes: Sequence[Scene]) -> str:
    """Return the page of `report`; the 3-D view shows `scenes`, usually those of the report."""
    sections = _sections(report)
    links = "".join(f'<li><a href="#{key}">{escape(title)}</a></li>' for key, title, _ in sections)
    body = "".join(_section(key, title, inner) for key, title, inner in sections)
    if report.provenance:
        links += '<li><a href="#provenance">How this was computed</a></li>'
        body += provenance_section(report.provenance)
    header = f'{_headline(report)}<nav aria-label="Contents"><ul>{links}</ul></nav>'
    footer = "Lengths in mm, other units beside the numbers. This page is self-contained: it loads nothing from the network."
    return page_html(
        report.title, header, body, footer, data=MarkerView(tuple(scenes)).data() if scenes else "", script=SCRIPT if scenes else ""
    )


def _headline(report: Report) -> str:
    sentences = "".join(f"<p{' class=lead' if i == 0 else ''}>{escape(s)}</p>" for i, s in enumerate(report.headline))
    cards = cards_html(parameter_cards(report.parameters))
    return _verdict(report.verdict) + cards + sentences + rms_bars(report.scenes)


def _verdict(verdict: VerdictNote | None) -> str:
    if verdict is None:
        return ""
    details = f"<ul>{''.join(f'<li>{escape(s)}</li>' for s in verdict.details)}</ul>" if verdict.details else ""
    kind = "" if verdict.sound else ' class="limits"'
    return f'<div id="verdict"{kind}><p class="lead"><strong>{escape(verdict.sentence)}</strong></p>{details}</div>'


def _section(key: str, title: str, inner: str) -> str:
    return f'<section id="{key}" class="long" aria-labelledby="h-{key}"><h2 id="h-{key}">{escape(title)}</h2>{inner}</section>\n'


def _sections(report: Report) -> list[tuple[str, str, str]]:
    """Return key, title and inner HTML of the sections that the report has, in reading order."""
    found = [
        ("view", "Predicted and measured markers in 3-D", MarkerView(report.scenes).html() if report.scenes else ""),
        ("accuracy", "Accuracy", table_html(report.accuracy) if report.accuracy else ""),
        ("residuals", "Residuals by marker layer", _residuals(report.residuals)),
        ("parameters", "Parameters", _parameters(report)),
        ("limits", "What the data do not determine", _limits(report.undetermined)),
        ("tables", "Further tables", "".join(table_html(t) for t in report.tables)),
    ]
    return [entry for entry in found if entry[2]]


def _residuals(sets: Sequence[ResidualSet]) -> str:
    plots = "".join(residual_panels(s) for s in sets)
    if not plots:
        return ""
    key = (
        "Predicted minus measured position along each axis. Dots: markers; vertical line: median of the layer; the lowest layer is at the "
        "bottom. Grey band: ±2 standard deviations of the measurement noise, which noise alone would leave in 5 % of the cases."
    )
    return f'<p class="note">{key}</p>{plots}'


def _parameters(report: Report) -> str:
    out = ""
    if report.parameters:
        key = "Circle: estimate. Line: 95 % confidence interval; an arrowhead or “?” marks a side that the data do not bound."
        out += parameter_table(report.parameters) + f'<p class="note">{key}</p>'
    if report.correlation is not None:
        key = "Near ±1 only a combination of the two parameters is determined, not each one separately. Columns are numbered like the rows."
        out += f'<h3>Correlation of the estimates</h3><p class="note">{key}</p>{correlation_table(report.correlation)}'
    return out


def _limits(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return f'<div class="limits"><ul>{"".join(f"<li>{escape(s)}</li>" for s in sentences)}</ul></div>'
