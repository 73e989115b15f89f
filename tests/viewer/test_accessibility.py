"""Every kind of page can be read without seeing it and used without a mouse; its colours have the contrast that WCAG 2.2 asks for.

The checks of the structure need nothing; those of axe-core need Chromium and the file that ``NAIBU_AXE`` names
(``axe.min.js`` of the npm package).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, opened_browser

from naibu.viewer.animation import MovingBody, animation_html
from naibu.viewer.cards import Card, cards_html
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.live.page import live_html
from naibu.viewer.live.scene import LiveScene
from naibu.viewer.marker_view import MarkerView
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, motion_html
from naibu.viewer.page_frame import asset, page_html
from naibu.viewer.result_page.page import report_html
from naibu.viewer.result_page.payload import Box, Correlation, ParameterRow, Report, ResidualSet, Scene, Step, VerdictNote
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Table, table_html

TABLE = Table("Numbers", ("quantity", "value"), (("force, N", 1.5), ("depth, mm", None)), caption="what they are", note="a note")
CARDS = (Card("Young's modulus", "10 kPa", "9 to 11 kPa"), Card("Force", "1.5 N"))
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def scene() -> Scene:
    marks = np.array([[1.0, 1.0, 1.0], [3.0, 1.0, 1.0], [1.0, 3.0, 2.0], [1.0, 1.0, 4.0]])
    steps = tuple(
        Step(f"{t:g}", t, TETRAHEDRON * (1.0 - 0.1 * t), marks * (1.0 - 0.1 * t), (Box((0.0, 0.0, 11.0), (9.0, 9.0, 1.0)),))
        for t in (0.0, 1.0)
    )
    return Scene(
        "a", "gel", "pressed", FACES, TETRAHEDRON, steps, np.arange(4), marks, marks * 0.89, np.full(4, 0.1), np.zeros(4, int), "fitted"
    )


def report_page() -> str:
    rows = (
        ParameterRow("e", "Young's modulus", 10.0, 9.0, 11.0, "kPa"),
        ParameterRow("nu", "Poisson's ratio", 0.49, 0.4, np.inf, "", "weak"),
    )
    matrix = np.array([[1.0, -0.8], [-0.8, 1.0]])
    return report_html(
        Report(
            "Gel", ("The markers lie within 0.1 mm.",), VerdictNote("Explained in part.", False, ("A reason.",)), (scene(),), TABLE,
            (ResidualSet.from_scene(scene()),), rows, Correlation(("E", "nu"), matrix), ("The friction.",), (TABLE,), {"seed": 1},
        )
    )  # fmt: skip


def chapter_page() -> str:
    figure = Figure("Fig. 1", "A line.", lambda canvas: canvas.subplots().plot([0, 1]), (2.0, 1.0))
    sections = (Section("First", ("Words.",), (TABLE,), (figure,)), Section("Second", (), (TABLE,)))
    return chapter_html(Chapter("c", "A chapter", sections, {"seed": 1}, CARDS, MarkerView((scene(),), {"choice": "State"})))


def motion_page() -> str:
    times, moved = np.array([0.0, 1.0]), np.stack([np.zeros((4, 3)), 0.1 * TETRAHEDRON])
    ball = RigidShape("ball", "sphere", np.ones(3), np.eye(3))
    fields = (ColourField("displacement, mm", np.linalg.norm(moved, axis=2)),)
    force = np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, -900.0]]])
    page = MotionPage(
        "Motion", ("One body.",), times, FACES, TETRAHEDRON, moved, fields, (ball,),
        np.zeros((2, 1, 3)), times, force, (TABLE,), {"seed": 1}, CARDS,
    )  # fmt: skip
    return motion_html(page, 1_000_000)


def slices_page() -> str:
    z, y, x = np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij")
    u = np.stack([0.1 * x, -0.1 * y, 0.0 * z], axis=-1)
    overlays = [Overlay("displacement, mm", np.linalg.norm(u, axis=-1)), Overlay("volume ratio J", 1.0 + 0.01 * x, middle=1.0)]
    images = [("reference", np.sin(x) + y), ("deformed", np.sin(x + 0.1) + y)]
    return slices_html(SliceView("Slices", ("It moved.",), np.ones(3), images, u, overlays, (TABLE,), cards=CARDS))


def animation_page() -> str:
    points, moved = TETRAHEDRON[:3, :2], np.stack([np.zeros((3, 2)), np.full((3, 2), 0.5)])
    body = MovingBody("body", points, np.array([[0, 1, 2]]), moved, np.array([[0.0] * 3, [1.0] * 3]), (("m", np.ones((2, 2))),))
    return animation_html("Animation", np.array([0.0, 1.0]), (body,), "displacement, mm", ("One body.",))


def live_view() -> str:
    cells, none = np.array([[0, 1, 2, 3]]), np.zeros((0, 3))
    tool = RigidShape("ball", "sphere", np.ones(3), np.eye(3))
    return live_html(LiveScene("Touched gel", ["A sentence."], TETRAHEDRON, FACES, cells, [tool], [], none, "strain, %", 1 / 60))


def plain_page() -> str:
    """As of planned experiments, and of the index over chapters."""
    return page_html("Planned experiment", f"{cards_html(CARDS)}<p class=lead>The best.</p>", table_html(TABLE), "naibu")


PAGES: dict[str, Callable[[], str]] = {
    "report": report_page, "chapter": chapter_page, "motion": motion_page, "slices": slices_page, "animation": animation_page,
    "live": live_view, "plain": plain_page,
}  # fmt: skip


class Outline(HTMLParser):
    """What assistive technology is told of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inside: list[str] = []
        self.unlabelled: list[str] = []
        self.title = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if not (tag == "svg" and "svg" in self.inside):  # a part of another picture
            self.tags.append((tag, found))
        named = "aria-label" in found or "aria-labelledby" in found or "label" in self.inside or found.get("type") == "hidden"
        if tag in {"input", "select", "textarea"} and not named:
            self.unlabelled.append(f"{tag} {found.get('id')}")
        if tag not in {"input", "img", "meta", "link", "br", "hr", "col", "path", "circle", "line", "rect"}:
            self.inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self.inside:
            del self.inside[len(self.inside) - 1 - self.inside[::-1].index(tag) :]

    def handle_data(self, data: str) -> None:
        if self.inside and self.inside[-1] == "title":
            self.title += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [found for name, found in self.tags if name == tag]


@pytest.mark.parametrize("kind", PAGES)
def test_structure(kind: str) -> None:
    page = PAGES[kind]()
    found = Outline(page)
    assert found.of("html")[0]["lang"] == "en" and found.title.strip()
    assert len(found.of("h1")) == 1 and len(found.of("main")) == 1
    levels = [int(tag[1]) for tag, _ in found.tags if re.fullmatch("h[1-6]", tag)]
    assert all(b <= a + 1 for a, b in pairwise(levels)), levels
    labelled = {label["for"] for label in found.of("label") if "for" in label}
    assert [c for c in found.unlabelled if c.split()[1] not in labelled] == []
    assert all(image.get("alt") for image in found.of("img"))
    assert all(svg.get("aria-hidden") == "true" or svg.get("aria-label") or svg.get("aria-labelledby") for svg in found.of("svg")), kind
    assert "maximum-scale" not in page and "user-scalable" not in page
    ids = [attributes["id"] for _, attributes in found.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert all(cell.get("scope") for cell in found.of("th"))


def luminance(colour: str) -> float:
    """Relative luminance of ``#rrggbb``, WCAG 2.2."""
    c = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    return float(np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])


def contrast(a: str, b: str) -> float:
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def palettes() -> dict[str, dict[str, str]]:
    """Colours of the style sheet by name, light and dark."""
    blocks = re.findall(r":root\s*\{([^}]*)\}", asset("report.css"))
    light, dark = (
        {n: v if len(v) == 7 else "#" + "".join(2 * c for c in v[1:]) for n, v in re.findall(r"--([\w-]+):\s*(#[0-9a-fA-F]{3,6})\b", b)}
        for b in blocks[:2]
    )
    return {"light": light, "dark": light | dark}


def test_black_on_white_has_the_largest_contrast() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_contrast_of_the_style_sheet(theme: str) -> None:
    colours = palettes()[theme]
    text = [(ink, ground) for ink in ("text", "soft", "accent", "strong", "median") for ground in ("ground", "panel")]
    text += [("text", "warn-ground"), ("text", "band"), ("text", "scene-background"), ("ground", "accent")]
    for ink, ground in text:  # success criterion 1.4.3
        assert contrast(colours[ink], colours[ground]) >= 4.5, (ink, ground)
    marks = [("dot", "ground"), ("warn-line", "warn-ground"), *((f"curve-{k}", "ground") for k in range(5))]
    marks += [(f"scene-{what}", "scene-background") for what in ("measured", "predicted", "edge")]
    for ink, ground in marks:  # success criterion 1.4.11
        assert contrast(colours[ink], colours[ground]) >= 3.0, (ink, ground)


AXE = os.environ.get("NAIBU_AXE", "")
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"], "resultTypes": ["violations"]}


@pytest.mark.skipif(not AXE or CHROMIUM is None, reason="NAIBU_AXE names no axe.min.js, or there is no Chromium")
def test_axe_finds_nothing(tmp_path: Path) -> None:
    script = Path(AXE).read_text(encoding="utf-8")
    troubles = []
    with opened_browser() as page:
        page.call("Page.setBypassCSP", enabled=True)
        for kind, made in PAGES.items():
            file = tmp_path / f"{kind}.html"
            file.write_text(made(), encoding="utf-8")
            for dark, width in ((False, 1200), (True, 420)):
                page.dark(dark)
                page.resize(width, 860)
                page.open(file.as_uri())
                page.wait(f"location.href === {json.dumps(file.as_uri())} && document.readyState === 'complete'")
                page.value(f"{script};1")
                found = page.value(
                    f"axe.run(document, {json.dumps(RULES)}).then(r => r.violations.map(v => v.id + ': ' + v.nodes[0].target))"
                )
                troubles += [f"{kind}, {'dark' if dark else 'light'}: {trouble}" for trouble in found]
    assert troubles == []
