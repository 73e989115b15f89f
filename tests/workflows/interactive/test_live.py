"""The live page in a real browser: it loads, pushes, pulls, reads the force, looks inside, comes back; and what can be touched."""

from __future__ import annotations

import gc
import json
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Page, opened_browser
from matplotlib.image import imread
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from served_models import served
from touched_lattice import touched_lattice
from virtual_press import Press

from naibu.core.errors import InputError
from naibu.io.vtk_files import write_vtu
from naibu.mechanics import IndenterVelocity, spherical_indenter
from naibu.meshing import box
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.simulation import FiniteElementBody, InteractiveSimulation, LatticeBody, RealTimeLoop
from naibu.workflows import MeshMaterial, TouchableModel, live, tools_for, touchable, touched_loop
from naibu.workflows.interactive.live import LiveSimulation


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_person_pushes_pulls_looks_inside_and_saves(tmp_path: Path) -> None:
    frame = "window.naibuLive && naibuLive.frame"
    with served() as (address, simulation), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.command('record', {on: true})")
        page.value("naibuLive.command('move', {at: [20, 20, 43]})")
        page.wait(f"{frame}.force[2] < -1", 60)
        assert page.value("naibuLive.numbers.force.textContent").endswith(" N")
        page.wait("Math.abs(parseFloat(naibuLive.numbers.indentation.textContent) - 2.6) < 0.15", 30)  # a sphere of radius 5.6, top at 40
        page.value("naibuLive.view.setClip(1, 0.5)")
        assert page.value("naibuLive.view.cap.geometry.attributes.position.count") > 50
        page.value("naibuLive.command('colour', {name: 'strain'}, true)")
        page.wait(f"{frame}.values !== null", 30)
        page.wait("naibuLive.ticks.textContent.endsWith(' %')", 30)
        page.value("naibuLive.command('colour', {name: 'displacement'}, true)")
        page.wait("naibuLive.ticks.textContent.endsWith(' mm')", 30)
        page.value("naibuLive.view.setClip(null)")

        page.value("naibuLive.take(''); naibuLive.setMode('pull')")
        page.wait(f"{frame}.tool === -1", 30)
        at = page.value(
            "(() => { const b = naibuLive.view.canvas.getBoundingClientRect(); const c = [b.left + b.width / 2, b.top + b.height / 2];"
            " return naibuLive.view.pick(...c) ? c : null; })()"
        )
        page.mouse("mousePressed", *at)
        page.wait(f"{frame}.gripped >= 0", 30)
        page.mouse("mouseMoved", at[0] + 40, at[1] - 20)
        page.wait(f"Math.hypot(...{frame}.pull) > 1", 30)
        page.mouse("mouseReleased", at[0] + 40, at[1] - 20)
        page.wait(f"{frame}.gripped < 0", 30)

        page.value("naibuLive.command('pause', {on: true})")
        page.wait("naibuLive.badge.textContent.startsWith('paused')", 30)
        page.value("naibuLive.link.socket.close()")
        page.wait("naibuLive.badge.textContent === 'not connected'", 30)
        page.wait("naibuLive.badge.textContent.startsWith('paused')", 30)
        assert page.console == []
        assert len(page.picture(tmp_path / "live.png").read_bytes()) > 10_000
        assert "Recorded from the live page." in simulation.recording_html()


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_the_page_says_of_the_tool_in_play_that_it_is_small_beside_the_cubes(tmp_path: Path) -> None:
    """The sphere has a radius of 5.6 mm, and cubes of 10 mm."""
    body = touched_lattice()
    tools = tools_for(body)
    assert body.caution("the sphere", tools["sphere"]).startswith("The radius of the sphere is 0.56 of the edge of the faces")
    assert body.caution("the sphere", spherical_indenter((0.0, 0.0, 60.0), 10.0)) == ""
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.wait("naibuLive.caution.textContent.startsWith('The radius of the sphere is 0.56')", 30)
        page.picture(tmp_path / "small.png")
        page.value("naibuLive.take('plate')")
        page.wait("naibuLive.frame.tool === 1 && naibuLive.caution.textContent === ''", 30)
        page.value("naibuLive.take('bar')")
        page.wait("naibuLive.caution.textContent.startsWith('The radius of the bar is 0.28')", 30)
        page.value("naibuLive.take('')")
        page.wait("naibuLive.frame.tool === -1 && naibuLive.caution.textContent === ''", 30)
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_the_tool_that_is_chosen_is_the_one_in_play_also_behind_undo_and_on_another_page() -> None:
    chosen, ready = "naibuLive.toolChoice.value", "document.querySelector('.stage[data-ready]') !== null"
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait(f"{ready} && naibuLive.frame.tool === 0", 60)
        first, second = page.value("naibuLive.scene.tools.slice(0, 2).map((tool) => tool.name)")
        page.value(f"naibuLive.take('{second}')")
        page.wait("naibuLive.frame.tool === 1", 30)
        page.value("naibuLive.nudge('up', 1)")
        page.value("naibuLive.back('undo')")
        page.wait("naibuLive.frame.tool === 0", 30)
        assert page.value(f"[{chosen}, naibuLive.tool, naibuLive.lead]") == [first, first, None]
        page.value(f"naibuLive.take('{second}')")
        page.wait("naibuLive.frame.tool === 1", 30)
        page.call("Page.reload")
        page.wait("window.naibuLive === undefined || !naibuLive.frame || naibuLive.frame.tool === 1", 30)
        page.wait(f"{ready} && naibuLive.frame.tool === 1", 60)
        assert page.value(chosen) == second
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_keys_wheel_and_gamepad_move_and_turn_the_tool(tmp_path: Path) -> None:
    turned = "2 * Math.acos(Math.min(1, Math.abs(naibuLive.frame.rotation[3])))"
    with served() as (address, simulation), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.take('plate')")
        page.wait("naibuLive.frame.tool === 1", 30)
        page.value("document.querySelector('.stage').focus()")
        page.key("z")
        page.wait(f"Math.abs({turned} - 0.1) < 1e-3", 30)
        wheel = "new WheelEvent('wheel', {deltaY: 200, altKey: true, bubbles: true, cancelable: true})"
        page.value(f"document.querySelector('.stage canvas').dispatchEvent({wheel})")  # the other way, twice as far
        page.wait(f"Math.abs({turned} - 0.1) < 1e-3 && naibuLive.view.tools[1].quaternion.angleTo(naibuLive.view.made[1]) > 0.09", 30)
        height = page.value("naibuLive.frame.centre[2]")
        buttons = "Array.from({length: 8}, () => ({pressed: false}))"
        page.value(f"window.pad = {{axes: [0, -1, 0, 0], buttons: {buttons}}}; navigator.getGamepads = () => [null, pad]")
        page.wait(f"naibuLive.frame.centre[2] > {height} + 1", 30)
        page.value("pad.axes = [0, 0, 1, 0]")
        page.wait(f"{turned} > 0.3", 30)
        page.value("pad.axes = [0, 0, 0, 0]; pad.buttons[5].pressed = true")
        before = page.value("naibuLive.frame.rotation")
        page.wait(f"Math.hypot(...naibuLive.frame.rotation.map((v, k) => v - {before}[k])) > 0.1", 30)
        page.value("pad.buttons[5].pressed = false; pad.axes = [0.05, 0.1, 0, 0]")  # a stick at rest
        still = page.value("new Promise((done) => setTimeout(() => done(naibuLive.frame.centre), 1500))")
        assert page.value("new Promise((done) => setTimeout(() => done(naibuLive.frame.centre), 500))") == still
        page.picture(tmp_path / "turned.png")
        odd = (
            "null",
            "[null]",
            "[{axes: [], buttons: []}]",
            "[{axes: [NaN, 0.9, 0, NaN]}]",
            "(() => { throw new Error('not allowed'); })()",
        )
        for pads in odd:
            page.value(f"navigator.getGamepads = () => {pads}")
            time_shown = page.value("naibuLive.numbers.time.textContent")
            page.wait(f"naibuLive.numbers.time.textContent !== '{time_shown}' && !isNaN(naibuLive.frame.centre[2])", 30)
        assert page.console == []
        rotation = simulation.loop.latest()[0].tool_rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_key_that_is_held_leads_the_tool_until_the_body_holds_it_back(tmp_path: Path) -> None:
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.view.look('front'); document.querySelector('.stage').focus()")
        before = page.value("naibuLive.frame.centre")
        page.key("s")  # a tap is one step
        page.wait(f"naibuLive.frame.centre[2] < {before[2]} - 0.5", 30)
        page.key_event("keyDown", "s")  # held, without repetitions
        page.wait("naibuLive.badge.textContent.includes('the body is crushed before the tool, which is held back')", 60)
        time.sleep(1.0)
        assert page.value("naibuLive.frame.force[2]") < -100.0
        assert page.value("naibuLive.frame.centre[2]") > 10.0
        page.picture(tmp_path / "held.png")
        page.key_event("keyUp", "s")
        page.key_event("keyDown", "w")  # back at once, however long the other key was held
        page.wait("naibuLive.frame.force.every((f) => f === 0) && !naibuLive.frame.held", 10)
        page.key_event("keyUp", "w")
        still = "new Promise((done) => setTimeout(() => done(naibuLive.frame.centre[2]), 1000))"
        page.value(still)
        assert page.value(still) == page.value(still)
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_recording_is_saved_as_a_page_that_plays_from_its_file_and_without_one_the_live_page_stays(tmp_path: Path) -> None:
    save = "[...document.querySelectorAll('button')].find((b) => b.textContent === 'Save as a page').click()"
    with served() as (address, simulation), opened_browser() as page:
        page.open(address)
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value(save)
        page.wait("naibuLive.message.textContent.startsWith('nothing is recorded; press Record')", 30)
        assert page.value("location.pathname") == "/"
        page.value("naibuLive.command('record', {on: true}); naibuLive.command('move', {at: [20, 20, 43]})")
        page.wait("naibuLive.frame.recording && naibuLive.frame.force[2] < -100", 60)
        time.sleep(1.0)
        page.value(f"naibuLive.command('record', {{on: false}}); {save}")
        for _ in range(200):
            if (tmp_path / "naibu-recording.html").is_file():
                break
            time.sleep(0.05)
        assert page.value("naibuLive.message.textContent") == ""
        assert [error for error in page.console if "409" not in error] == []  # the browser notes the refusal
        page.console.clear()
        page.open((tmp_path / "naibu-recording.html").as_uri())
        page.wait("document.querySelector('.stage canvas') !== null", 60)
        assert "sphere" in page.value("document.body.textContent")
        before = page.value("document.querySelector('input[type=range]').value")
        page.value("[...document.querySelectorAll('button')].find((b) => b.textContent.includes('Play')).click()")
        page.wait(f"document.querySelector('input[type=range]').value !== '{before}'", 30)
        assert page.console == []
        assert simulation.loop.recorded()


PROJECTED = (
    "(() => { const b = naibuLive.view.canvas.getBoundingClientRect();"
    " const p = naibuLive.view.camera.position.clone().set(...naibuLive.frame.centre).project(naibuLive.view.camera);"
    " return [b.left + (p.x + 1) / 2 * b.width, b.top + (1 - p.y) / 2 * b.height]; })()"
)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_on_a_phone_one_finger_pushes_and_two_look_closer(tmp_path: Path) -> None:
    with served() as (address, _), opened_browser(390, 844) as page:
        page.resize(390, 844, scale=3.0)
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        assert page.value("document.documentElement.scrollWidth") <= 390
        assert "keys" not in page.value("naibuLive.hint.textContent")
        x, y = page.value(PROJECTED)
        page.touch("touchStart", (x, y))
        for k in range(1, 9):
            page.touch("touchMove", (x, y + 4 * k))
        page.wait("naibuLive.frame.force[2] < -100 && parseFloat(naibuLive.readout.textContent) > 0.1", 30)
        seen = page.value("(() => { const b = naibuLive.readout.getBoundingClientRect(); return [b.width, b.top, b.bottom]; })()")
        assert seen[0] > 20 and 0 < seen[1] < seen[2] < 844  # the force is seen beside the finger
        page.value("naibuLive.message.textContent = 'a cut is under way'")
        boxes = "[naibuLive.stage, naibuLive.badge, naibuLive.message].map((e) => e.getBoundingClientRect())"
        stage, *told = page.value(f"{boxes}.map((b) => [b.left, b.top, b.right, b.bottom])")
        for left, top, right, bottom in told:  # slower than real time, or refused: it had stood two screens below
            assert stage[0] <= left < right <= stage[2] and stage[1] <= top < bottom <= stage[3]
        page.picture(tmp_path / "phone.png")
        page.touch("touchEnd")
        left, top = page.value("(() => { const b = naibuLive.view.canvas.getBoundingClientRect(); return [b.left, b.top]; })()")
        zoom = page.value("naibuLive.view.camera.zoom")
        page.touch("touchStart", (left + 20, top + 20), (left + 60, top + 20))
        for k in range(1, 7):
            page.touch("touchMove", (left + 20, top + 20), (left + 60 + 8 * k, top + 20))
        page.touch("touchEnd")
        page.wait(f"naibuLive.view.camera.zoom > 1.3 * {zoom}", 10)
        assert page.value("scrollY") == 0
        page.value("[...document.querySelectorAll('button')].find((b) => b.textContent === 'Whole view').click()")
        assert page.value("naibuLive.view.camera.zoom") == 1
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_point_is_probed_until_the_body_is_another_and_shortened_elements_are_told_from_lengthened_ones(tmp_path: Path) -> None:
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.command('move', {at: [20, 20, 36]}); naibuLive.command('colour', {name: 'strain'}, true)")
        page.wait("naibuLive.frame.values !== null && Math.min(...naibuLive.frame.values) < -2", 30)
        page.wait("naibuLive.ticks.textContent.startsWith('−') && naibuLive.ticks.children[2].textContent === '0'", 30)
        values, level, top = page.value("[[...naibuLive.frame.values], [...naibuLive.view.level.array], naibuLive.view.top]")
        np.testing.assert_allclose((2.0 * np.array(level) - 1.0) * top, values, atol=0.02 * top)
        assert top >= np.abs(values).max()
        page.picture(tmp_path / "signed.png")
        page.value("naibuLive.command('colour', {name: 'displacement'}, true)")
        page.wait("naibuLive.ticks.firstChild.textContent === '0'", 30)
        page.value("naibuLive.take(''); naibuLive.setMode('probe')")
        page.wait("naibuLive.frame.tool < 0", 30)
        at = page.value(
            "(() => { const b = naibuLive.view.canvas.getBoundingClientRect(); const c = [b.left + b.width / 2, b.top + b.height / 2];"
            " return naibuLive.view.pick(...c) ? c : null; })()"
        )
        page.mouse("mousePressed", *at)
        page.mouse("mouseReleased", *at)
        page.wait("naibuLive.numbers.probe.textContent.startsWith('moved (')", 30)
        page.value("naibuLive.command('cut', {edges: [-50, 50].map((y) => [[-50, y, 21], [90, y, 21]])})")
        page.wait("naibuLive.scene.topology === 1 && naibuLive.frame.topology === 1", 60)
        page.wait("naibuLive.numbers.probe.textContent === '–'", 30)  # its nodes are others
        assert page.console == []


def pieces(simulation: LiveSimulation) -> int:
    scene = simulation.scene
    ends = np.concatenate([scene.cells[:, 0]] * 3), scene.cells[:, 1:].T.ravel()
    graph = coo_array((np.ones(len(ends[0])), ends), shape=(len(scene.points),) * 2)
    return int(connected_components(graph, directed=False)[0])


def view_of(page: Page, picture: Path) -> np.ndarray:
    """Return the pixels (h, w, 3) of the 3-D view, which are also written with those of the page to a file."""
    box = page.value("(() => { const b = naibuLive.view.canvas.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })()")
    left, top, right, bottom = (round(edge) for edge in box)
    return np.asarray(imread(page.picture(picture))[top:bottom, left:right, :3])


def outlined(page: Page, picture: Path) -> int:
    """Number of black pixels of the 3-D view that are a few pixels from white ones: those of the line of a cut, on any colour."""
    shown = view_of(page, picture)
    return int(((shown < 0.02).all(axis=2) & binary_dilation((shown > 0.99).all(axis=2), iterations=3)).sum())


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
@pytest.mark.parametrize("kind", ["mesh", "lattice"])
def test_a_person_cuts_a_body_and_takes_it_back(tmp_path: Path, kind: str) -> None:
    write_vtu(tmp_path / "gel.vtu", box((30.0, 30.0, 30.0), (4, 4, 4), cell_type="tetra"))
    model = touchable(tmp_path / "gel.vtu") if kind == "mesh" else None  # of 5 x 5 x 5 nodes both
    with served(model) as (address, simulation), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.take(''); naibuLive.setMode('cut')")
        assert page.value("naibuLive.scene.outline.length") == 0 and outlined(page, tmp_path / "whole.png") == 0
        left, top, width, height = page.value(
            "(() => { const b = naibuLive.view.canvas.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()"
        )
        page.value(
            "window.told = []; new MutationObserver(() => { const { element, text } = naibuLive.notice;"
            " if (!element.hidden) told.push(text.textContent); }).observe(naibuLive.notice.element, {attributes: true, subtree: true})"
        )
        path = [(left + width * 0.5, top + height * (0.08 + 0.03 * k)) for k in range(16)]
        page.mouse("mousePressed", *path[0])
        for at in path[1:]:
            page.mouse("mouseMoved", *at)
        page.mouse("mouseReleased", *path[-1])
        page.wait("told.length > 0", 30)
        assert page.value("told[0]") == "Cutting…"
        page.wait("naibuLive.scene.topology === 1 && naibuLive.frame.topology === 1", 60)
        assert page.value("naibuLive.scene.points.length") > 3 * 125
        assert simulation.scene.topology == 1
        page.wait("naibuLive.notice.element.hidden && naibuLive.conflicting.every((control) => !control.disabled)", 30)
        assert page.value("naibuLive.scene.outline.length") > 0  # the cut is closed: its outline shows where it is
        page.wait("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
        for dark in (False, True):
            page.dark(dark)
            time.sleep(0.5)
            assert outlined(page, tmp_path / f"{kind}.png") > 100
        if kind == "mesh":  # a closed line, but for a gap of some pixels, cuts a second piece out
            radius, before = 0.13 * height, pieces(simulation)
            ring = [(left + 0.5 * width + radius * np.cos(t), top + 0.62 * height + radius * np.sin(t)) for t in np.linspace(0.0, 6.2, 24)]
            page.mouse("mousePressed", *ring[0])
            for at in ring[1:]:
                page.mouse("mouseMoved", *at)
            page.mouse("mouseReleased", *ring[-1])
            page.wait("naibuLive.scene.topology === 2 && naibuLive.frame.topology === 2", 60)
            assert pieces(simulation) == before + 1
            page.picture(tmp_path / "loop.png")
            page.value("naibuLive.command('undo')")
            page.wait("naibuLive.scene.topology === 3 && naibuLive.frame.topology === 3", 60)
        page.value("naibuLive.command('undo')")
        page.wait("naibuLive.frame.topology === naibuLive.scene.topology && naibuLive.scene.points.length === 375", 60)
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_what_was_wrong_is_told_until_it_is_over_or_something_else_is_begun() -> None:
    said = "naibuLive.message.textContent"
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.notice.ask(); naibuLive.command('undo')")  # as if a cut were under way
        assert page.value(said) == "A cut is being computed: wait until it opens."
        page.value("naibuLive.notice.forget()")
        page.wait(f"{said} === ''", 30)
        page.value("naibuLive.command('cut', {edges: [[[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]]})")
        page.wait(f"{said}.startsWith('the blade sweeps no area')", 30)
        page.value("naibuLive.command('move', {at: [20, 20, 60]})")
        assert page.value(said).startswith("the blade sweeps no area")  # still to be read
        page.value("naibuLive.command('pause', {on: true})")
        assert page.value(said) == ""
        assert page.console == []


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_markers_are_seen_in_a_section_and_the_tool_that_waits_is_seen_whole(tmp_path: Path) -> None:
    body = touched_lattice()
    inner = np.flatnonzero((np.abs(body.points - body.points.mean(axis=0)) < 0.45 * np.ptp(body.points, axis=0)).all(axis=1))
    model = TouchableModel("Cube", (), body, "mean elongation, %", np.repeat(inner[:, None], 2, axis=1), np.full((len(inner), 2), 0.5))
    with served(model) as (address, _), opened_browser(800, 700) as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        farthest = page.value(
            "(() => { const { view, frame } = naibuLive; const tool = view.tools[frame.tool]; tool.updateMatrixWorld(true);"
            " const at = tool.children[0].geometry.attributes.position; const p = view.camera.position.clone(); let most = 0;"
            " for (let i = 0; i < at.count; i += 1) { p.fromBufferAttribute(at, i).applyMatrix4(tool.matrixWorld).project(view.camera);"
            " most = Math.max(most, Math.abs(p.x), Math.abs(p.y)); } return most; })()"
        )
        assert 0.0 < farthest < 1.0  # of half the picture
        page.value("naibuLive.take(''); naibuLive.view.setMarkers(true)")
        page.wait("naibuLive.frame.tool < 0")
        seen = []
        for clip in ("null", "1, 0.5", "1, 0.02"):
            page.value(f"naibuLive.view.setClip({clip}); naibuLive.view.renderFinest()")
            page.wait("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
            shown = view_of(page, tmp_path / "section.png")
            seen.append(int(((shown[..., 0] > 0.6) & (shown[..., 1] < 0.5) & (shown[..., 2] < 0.2)).sum()))
        assert seen[0] == 0  # within an opaque body
        assert seen[1] > 30
        assert seen[2] == 0  # none lies so near to the side of the cube


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_what_conflicts_with_a_cut_under_way_waits_and_long_steps_are_told(tmp_path: Path) -> None:
    with served() as (address, simulation), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        page.value("naibuLive.notice.ask()")
        page.wait("naibuLive.conflicting.length === 5 && naibuLive.conflicting.every((control) => control.disabled)", 30)
        page.value("naibuLive.take(''); naibuLive.command('undo')")
        assert "wait until it opens" in page.value("naibuLive.message.textContent")
        page.picture(tmp_path / "cutting.png")
        page.value("naibuLive.notice.forget()")
        page.wait("naibuLive.conflicting.every((control) => !control.disabled)", 30)
        assert simulation.frame().tool == 0
        seen = page.value(
            "(() => { const n = naibuLive.notice; const told = [];"
            " for (const [cutStage, underWay, at] of [[1, false, 0], [-1, true, 100], [-1, true, 900], [-1, false, 950]]) {"
            " n.follow({ cutStage, underWay }, at); told.push([n.element.hidden, n.cutting, n.text.textContent, n.bar.value]); }"
            " return told; })()"
        )
        assert [s[:2] for s in seen] == [[False, True], [True, False], [False, False], [True, False]]
        assert "volume strains" in seen[0][2] and seen[0][3] == 1.5 and "takes long" in seen[2][2]


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_section_between_two_layers_of_markers_shows_both() -> None:
    """Layers 32 mm apart, of 9 markers each: half the mean distance of markers in the cube of 40 mm is 7.6 mm."""
    body = touched_lattice()
    x, y, z = body.points.T
    both = np.flatnonzero((np.abs(x - 20.0) < 11.0) & (np.abs(y - 20.0) < 11.0) & (np.abs(z - 20.0) > 19.0))
    assert len(both) == 18
    inward = np.ravel_multi_index((2, 2, 2), (5, 5, 5))
    weights = np.tile([0.8, 0.2], (len(both), 1))  # at z = 4 and 36 mm
    np.testing.assert_allclose(body.points[inward], 20.0)
    model = TouchableModel("Cube", (), body, "mean elongation, %", np.stack([both, np.full(len(both), inward)], axis=1), weights)
    count = (
        "(() => { const m = naibuLive.view.markers; let n = 0; for (let q = 0; q < m.count; q += 1)"
        " n += m.instanceMatrix.array[16 * q] > 0; return n; })()"
    )
    with served(model) as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null", 60)
        page.value("naibuLive.view.setMarkers(true)")
        seen = []
        for clip in ("null", "2, 0.5", "2, 0.85", "2, 1.0"):
            page.value(f"naibuLive.view.setClip({clip})")
            seen.append(page.value(count))
        assert seen == [18, 18, 9, 9]


def test_markers_come_back_when_a_cut_is_undone() -> None:
    body = touched_lattice()
    model = TouchableModel("Cube", (), body, "mean elongation, %", np.array([[0, 1]]), np.array([[0.5, 0.5]]))
    loop = RealTimeLoop(InteractiveSimulation(body, {}))
    live_one, found = LiveSimulation(model, loop), []
    blade = [[[-50.0, y, 21.0], [50.0, y, 21.0]] for y in (-50.0, 50.0)]
    for command in (lambda s: None, lambda s: s.cut(blade), lambda s: s.undo()):
        loop.submit(command)
        loop._obey()
        found.append((live_one.scene.topology, len(live_one.scene.marker_nodes)))
    assert found == [(0, 1), (1, 0), (2, 1)]


def test_a_mesh_is_held_at_its_lowest_nodes_and_pressed(tmp_path: Path) -> None:
    mesh = box((30.0, 30.0, 30.0), (3, 3, 3), cell_type="tetra")
    write_vtu(tmp_path / "gel.vtu", mesh)
    model = touchable(tmp_path / "gel.vtu", material=MeshMaterial(young_modulus_kpa=20.0, poisson_ratio=0.49))
    touched = InteractiveSimulation(model.body, tools_for(model.body))
    touched.take("plate")
    touched.move((0.0, 0.0, 30.0 + 0.06 * 30.0 - 3.0))
    for _ in range(30):
        frame = touched.advance()
    stress = -frame.force[2] / 900.0
    assert 20.0 * 0.1 < stress < 20.0 * 0.1 * 2.5  # 10 % of a block whose ends stick: above E times strain
    low = mesh.points[:, 2] < 1e-9
    np.testing.assert_allclose(frame.positions[low], mesh.points[low], atol=1e-12)
    assert model.body.strain(frame.positions).max() > 5.0
    assert frame.penetration_mm < 0.1


def test_forces_of_a_model_of_ratios_are_told_to_be_in_proportion(press: Press, tmp_path: Path) -> None:
    stored = json.loads((press.results / "model.json").read_text(encoding="utf-8"))
    for absolute in (True, False):
        stored["known"]["scale_is_absolute"] = absolute
        (tmp_path / "model.json").write_text(json.dumps(stored), encoding="utf-8")
        said = " ".join(touchable(tmp_path / "model.json", experiment=press.folder).sentences)
        assert ("No modulus is known" in said and "in proportion" in said) is not absolute


def test_what_cannot_be_touched_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is neither a model"):
        touchable("no-such-thing")
    with pytest.raises(InputError, match="material goes with a mesh"):
        touchable("cube-pushing", material=MeshMaterial())
    with pytest.raises(InputError, match="poisson_ratio"):
        MeshMaterial(poisson_ratio=0.5)
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(InputError, match="not a naibu model"):
        touchable(tmp_path / "model.json")


def test_sides_of_cuts_of_a_live_body_rub_where_friction_is_given(tmp_path: Path) -> None:
    path = tmp_path / "block.vtu"
    write_vtu(path, box((20.0, 20.0, 20.0), (3, 3, 3), cell_type="tetra"))
    body = replace(touchable(path, material=MeshMaterial()).body, lips_friction=0.4)
    assert isinstance(body, FiniteElementBody)
    for x in (0.5, -6.0):  # the second cut keeps it too
        edge = np.array([[x, -11.0, -11.0], [x, -11.0, 11.0]])
        body, _, _ = body.cut(body.engine.rest(), swept_blade(np.stack([edge, edge + np.array([0.0, 12.0, 0.0])])))
        assert body.engine.assembler.unsymmetric and body.engine.assembler.lips.friction == 0.4
    with closing(body.session()) as session:
        session.step(body.grip_velocity(np.zeros(3)), [])
    with pytest.raises(InputError, match="lips_friction must be a finite number"):
        live(path, lips_friction=-0.1, ready=print)
    with pytest.raises(InputError, match=r"lips_friction must be 0, not 0\.3"):
        live("dough-pressed-by-sphere", port=0, lips_friction=0.3, ready=print)


def test_a_file_that_is_not_there_is_told_before_anything_is_prepared(tmp_path: Path) -> None:
    prepared: list[bool] = []
    with pytest.raises(InputError, match=r"nothere\.vtu"):
        live(tmp_path / "nothere.vtu", preparing=lambda: prepared.append(True), ready=lambda _: None)
    assert not prepared


def test_a_taken_port_is_named() -> None:
    with served() as (address, _):
        port = int(address.split(":")[2].split("/")[0])
        with pytest.raises(InputError, match=f"port {port} is taken"):
            live("cube-pushing", port=port, ready=lambda _: None)
    with pytest.raises(InputError, match="between 0 and 65535"):
        live("cube-pushing", port=70000, ready=lambda _: None)


def test_steps_of_a_lattice_on_the_live_page_are_solved_closely_enough() -> None:
    """Forces of a sphere that goes down in dough and then to and fro, beside those of a solver with a residual a thousand times smaller."""
    body = touchable("dough-pressed-by-sphere").body
    assert isinstance(body, LatticeBody)
    high = body.points.max(axis=0)
    ball = spherical_indenter((*body.points.mean(axis=0)[:2], high[2] + 10.0), 10.0, static_friction=0.3, kinetic_friction=0.3)
    forces = []
    for engine in (body.engine, replace(body.engine, tolerance=1e-4)):
        found = []
        with replace(body, engine=engine).session() as session:
            session.press([*body.fixtures, ball])
            still = [IndenterVelocity() for _ in body.fixtures]
            for t in 1e-3 * np.arange(900):
                way = [0.0, 0.0, -10.0] if t < 0.4 else [40.0 * np.cos(9.0 * t), 30.0 * np.sin(7.0 * t), -7.0 + 5.0 * np.sin(15.0 * t)]
                found.append(session.step(np.zeros((2, 3)), [*still, IndenterVelocity(way)]).indenters[0, -1])
        forces.append(np.array(found))
    apart = np.linalg.norm(forces[0] - forces[1], axis=1) / np.linalg.norm(forces[1], axis=1).max()
    assert np.sqrt((apart**2).mean()) < 1e-3 and np.quantile(apart, 0.99) < 5e-3
    assert apart[-100:].max() < 5e-3 and np.linalg.norm(forces[1][-1]) > 100.0  # errors do not add up


def test_no_frame_waits_for_a_search_for_cycles_in_all_that_was_imported() -> None:
    """Such a search held the thread that steps a pulled gel for 110 ms, as the loop left out what was there before for devices only."""
    gc.unfreeze()
    try:
        with touched_loop(TouchableModel("Cube", (), touched_lattice(), "mean elongation, %")):
            searched, frozen = len(gc.get_objects()), gc.get_freeze_count()
        assert gc.get_freeze_count() == 0
        assert searched < 0.1 * frozen
    finally:
        gc.freeze()  # as `conftest` leaves it
