"""Names from files and options are shown as text on every kind of page, and never run; pages run their own script and nothing else."""

from __future__ import annotations

import base64
import hashlib
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from naibu.viewer.animation import MovingBody, animation_html
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, motion_html
from naibu.viewer.result_page.page import report_html
from naibu.viewer.result_page.payload import Box, Correlation, ParameterRow, Report, ResidualSet, Scene, Step
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Table

HOSTILE = "<!--<script>document.title='run'</script><img src=x onerror=\"document.title='run'\">$DATA $POLICY $TITLE 'x' & \u2028"
TABLE = Table(HOSTILE, (HOSTILE, "value"), ((HOSTILE, 1.0),), caption=HOSTILE, note=HOSTILE)
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 30.0, 0.0], [0.0, 0.0, 30.0]])


def result_page() -> str:
    markers = np.array([[5.0, 5.0, 5.0], [8.0, 5.0, 5.0]])
    steps = tuple(
        Step(HOSTILE, t, TETRAHEDRON * (1.0 - 0.1 * t), markers * (1.0 - 0.1 * t), (Box((15.0, 15.0, 32.0), (20.0, 20.0, 2.0)),))
        for t in (0.0, 1.0)
    )
    scene = Scene(
        name=HOSTILE, experiment=HOSTILE, state=HOSTILE, faces=TRIANGLES, reference_surface=TETRAHEDRON, steps=steps,
        marker_ids=np.array([1, 2]), initial_markers=markers, measured=0.91 * markers, sd_mm=np.full(2, 0.1), layer=np.zeros(2, dtype=int),
        role="fitted",
    )  # fmt: skip
    row = ParameterRow(HOSTILE, HOSTILE, 1.0, 0.5, 2.0, "kPa", HOSTILE)
    report = Report(
        title=HOSTILE, headline=(HOSTILE,), scenes=(scene,), accuracy=TABLE, residuals=(ResidualSet.from_scene(scene),), parameters=(row,),
        correlation=Correlation((HOSTILE, "b"), np.array([[1.0, 0.4], [0.4, 1.0]])), undetermined=(HOSTILE,), tables=(TABLE,),
        provenance={HOSTILE: HOSTILE},
    )  # fmt: skip
    return report_html(report)


def motion_page() -> str:
    moved = np.stack([np.zeros((4, 3)), np.full((4, 3), 2.0)])
    page = MotionPage(
        HOSTILE, (HOSTILE,), np.array([0.0, 1.0]), TRIANGLES, TETRAHEDRON, moved, (ColourField(HOSTILE, np.linalg.norm(moved, axis=2)),),
        (RigidShape(HOSTILE, "box", np.ones(3), np.eye(3)),), np.zeros((2, 1, 3)), np.array([0.5, 1.0]), np.ones((2, 1, 3)), (TABLE,),
        {HOSTILE: HOSTILE},
    )  # fmt: skip
    return motion_html(page, 5_000_000)


def chapter_page() -> str:
    figure = Figure(HOSTILE.replace("$", ""), HOSTILE, lambda canvas: canvas.subplots().plot([0, 1], [0, 1]) and None)
    return chapter_html(Chapter("ch", HOSTILE, (Section(HOSTILE, (HOSTILE,), (TABLE,), (figure,)),), {HOSTILE: HOSTILE}))


def animation_page() -> str:
    points = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    moved = np.stack([np.zeros((3, 2)), np.ones((3, 2))])
    body = MovingBody(HOSTILE, points, np.array([[0, 1, 2]]), moved, np.array([[0.0, 1, 2], [1, 2, 3]]), ((HOSTILE, np.ones((2, 2))),))
    return animation_html(HOSTILE, np.array([0.0, 1.0]), (body,), HOSTILE, [HOSTILE])


def slices_page() -> str:
    rng = np.random.default_rng(0)
    values = rng.random((4, 5, 6))
    view = SliceView(
        title=HOSTILE, sentences=(HOSTILE,), spacing_mm=np.ones(3), images=[(HOSTILE, values), ("b", values)],
        displacement=rng.random((4, 5, 6, 3)), overlays=[Overlay(HOSTILE, values)], tables=[TABLE], difference=((HOSTILE, 0, 1),),
    )  # fmt: skip
    return slices_html(view)


PAGES = {"result": result_page, "motion": motion_page, "chapter": chapter_page, "animation": animation_page, "slices": slices_page}


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {kind: page() for kind, page in PAGES.items()}


class Elements(HTMLParser):
    """The scripts, styles and names of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.code: list[str] = []
        self.data: list[str] = []
        self.styles: list[str] = []
        self.policies: list[str] = []
        self.handlers: list[str] = []
        self._into: list[str] | None = None
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.handlers += [name for name in given if name.startswith("on")]
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policies.append(given["content"] or "")
        if tag in ("script", "style"):
            self._into = self.styles if tag == "style" else self.data if "type" in given else self.code
            self._into.append("")

    def handle_data(self, data: str) -> None:
        if self._into is not None:
            self._into[-1] += data

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self._into = None


@pytest.mark.parametrize("kind", PAGES)
def test_the_policy_allows_what_stands_on_the_page_and_nothing_else(pages: dict[str, str], kind: str) -> None:
    found = Elements(pages[kind])
    assert len(found.policies) == 1 and not found.handlers
    rules = {rule.split()[0]: rule.split()[1:] for rule in found.policies[0].split("; ")}
    assert rules["default-src"] == ["'none'"] and "connect-src" not in rules
    for name, texts in (("script-src", found.code), ("style-src", found.styles)):
        digests = [f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in texts]
        assert rules[name] == (digests or ["'none'"])
    assert pages[kind].index("http-equiv") < pages[kind].index("<style") and len(found.code) == (kind != "chapter")


@pytest.mark.parametrize("kind", PAGES)
def test_names_are_text(pages: dict[str, str], kind: str) -> None:
    page, found = pages[kind], Elements(pages[kind])
    assert "<!--<script>" not in page and "<img src=x" not in page
    assert all("<" not in text for text in found.data) and (found.data or kind == "chapter")
    assert "document.title=&#x27;run&#x27;" in page and "$DATA $POLICY $TITLE" in page  # shown, not filled in once more


BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("kind", PAGES)
def test_a_browser_shows_the_page_without_complaint(pages: dict[str, str], kind: str, tmp_path: Path) -> None:
    assert BROWSER is not None
    file = tmp_path / "page.html"
    file.write_text(pages[kind], encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command = [BROWSER, *options, "--enable-logging=stderr", "--virtual-time-budget=4000", "--dump-dom", f"file://{file}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    console = re.findall(r"CONSOLE.*", done.stderr)
    assert not [line for line in console if re.search(r"Refused|violates|Uncaught|Error", line)], console
    assert "<title>run</title>" not in done.stdout
    drawn = {"result": "<canvas", "motion": "<canvas", "animation": "<canvas", "slices": "<canvas", "chapter": "<img"}
    assert drawn[kind] in done.stdout.replace("&lt;", "")
