"""The fingertip of the live page: loads on the chip as in statics, forces decoded within their intervals, and the page that shows them."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, opened_browser
from served_models import served
from threadpoolctl import threadpool_limits

from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import FingertipModel, Press
from naibu.applications.fingertip.whole_fingertip import WholeFingertip
from naibu.core.errors import InputError
from naibu.mechanics import RealTimeEngine
from naibu.simulation import InteractiveSimulation, RealTimeLoop
from naibu.simulation.interactive_bodies import FiniteElementBody
from naibu.viewer.live.commands import LiveCommand
from naibu.workflows import TouchableModel, live
from naibu.workflows.applications.fingertip_study import prepared_fingertip
from naibu.workflows.interactive.live import LiveSimulation
from naibu.workflows.interactive.touchable_fingertip import DECODED, LOADS, touchable_fingertip

DECODER = Path(str(files("naibu") / "datasets" / "data" / "fingertip_decoder.json"))


@pytest.fixture(scope="module")
def fingertip() -> TouchableModel:
    made = touchable_fingertip("fingertip")
    assert isinstance(made.body, FiniteElementBody) and isinstance(made.body.engine, RealTimeEngine)
    return replace(made, body=replace(made.body, engine=replace(made.body.engine, background=False)))  # repeatable


def test_the_decoder_that_comes_with_naibu_is_that_of_the_study_that_comes_with_it() -> None:
    assert json.loads(DECODER.read_text())["study"].endswith(prepared_fingertip("fingertip").digest)


def test_the_chip_of_the_whole_fingertip_bears_what_it_does_in_statics() -> None:
    """Statics of a half, with the deformable package that is held here; the same displacement, mirrored."""
    resolution = FingertipResolution(3, 2, 8)
    half = FingertipModel.of(Fingertip(), resolution)
    pressing = half.pressed(Press(20.0, 1500.0), keep_displacement=True)
    whole = WholeFingertip.of(Fingertip(), resolution)
    moved = {tuple(p.round(9)): u for p, u in zip(half.mesh.points, pressing.displacement_mm[-1], strict=True)}
    mirror = np.array([1.0, -1.0, 1.0])
    displacement = np.array(
        [moved[tuple(p.round(9))] if p[1] >= 0.0 else mirror * moved[tuple((mirror * p).round(9) + 0.0)] for p in whole.mesh.points]
    )
    np.testing.assert_allclose(whole.chip_loads(whole.mesh.points + displacement), pressing.chip_loads[-1], rtol=2e-3, atol=1e-3)


def test_a_rod_that_is_led_around_points_to_the_centre_and_its_force_is_decoded(fingertip: TouchableModel) -> None:
    simulation = InteractiveSimulation(fingertip.body, fingertip.tools or {})
    sensor = fingertip.sensor
    assert sensor is not None
    simulation.take("rod")
    tilt, azimuth = np.deg2rad(18.0), np.deg2rad(250.0)
    outwards = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    for reach in (15.5, 12.9):  # the rod is 8 mm long: its end is at 11.5 mm, then at 8.9 mm from the centre
        for _ in range(70):
            simulation.move(reach * outwards)
            simulation.aim(-outwards)
            frame = simulation.advance()
            values = sensor.at(frame)
    axis = frame.tool_rotation @ (0.0, 0.0, -1.0)
    np.testing.assert_allclose(axis, -outwards, atol=1e-6)
    read = dict(zip((r.name for r in (*LOADS, *DECODED)), values, strict=True))
    force = 1e-3 * float(np.linalg.norm(frame.force))
    assert 0.8 < force < 3.0
    assert read["force of the rod"][0] == pytest.approx(force)
    value, low, high = read["decoded force"]
    assert low < force < high and value == pytest.approx(force, rel=0.06)
    value, low, high = read["decoded tilt"]
    assert low < read["tilt of the force"][0] < high and value == pytest.approx(read["tilt of the force"][0], abs=1.0)
    assert 13.0 < value < 18.5  # of the rod less what friction takes
    assert read["decoded azimuth"][0] % 360.0 == pytest.approx(250.0, abs=3.0)
    assert read["decoded sideways share"][1] < 0.05
    assert read["load"][0] == 0.0  # at rest for a second
    statics = FingertipModel.of(Fingertip(), FingertipResolution(4, 2, 10)).pressed(Press(18.0, 1.1e3 * force))
    loads = statics.at_force(np.array([1e3 * force]))[0]
    assert np.hypot(read["M_x on the chip"][0], read["M_y on the chip"][0]) == pytest.approx(abs(loads[4]), rel=0.12)
    assert read["F_z on the chip"][0] == pytest.approx(loads[2], rel=0.12)  # that mesh is within 8 % of converged
    simulation.close()


@pytest.mark.parametrize(
    ("tilt", "azimuth", "way"),
    [
        (18.0, 250.0, 0.0),
        (18.0, 250.0, 1.0),
        (25.0, 120.0, -1.0),
        pytest.param(8.0, 30.0, 1.2, marks=pytest.mark.slow),
        pytest.param(12.0, 200.0, 0.6, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_the_force_while_the_rod_moves_and_drags(fingertip: TouchableModel, tilt: float, azimuth: float, way: float) -> None:
    """The truth is the rod's own force; it is pressed by 2 mm/s, which the filter follows late, then dragged by `way` at 1 mm/s."""
    simulation = InteractiveSimulation(fingertip.body, fingertip.tools or {})
    assert fingertip.sensor is not None
    sensor = replace(fingertip.sensor)  # its own noise, filter and offset
    t, a = np.deg2rad(tilt), np.deg2rad(azimuth)
    outwards = np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
    across = np.array([np.cos(t) * np.cos(a), np.cos(t) * np.sin(a), -np.sin(t)])
    simulation.take("rod")
    reach, dragged, last, rows, forces = 15.5, 0.0, 0.0, [], []
    for k in range(200 if way else 70):
        simulation.move(reach * outwards + dragged * across)
        simulation.aim(-outwards)
        frame = simulation.advance()
        values = dict(zip((r.name for r in (*LOADS, *DECODED)), sensor.at(frame).copy(), strict=True))
        passed, last = frame.time_s - last, frame.time_s
        if k == 30:
            reach = 14.2
        elif k > 30:
            reach = max(12.9, reach - 2.0 * passed)
        if k > 100:
            dragged += float(np.clip(way - dragged, -passed, passed))
        force, true = values["decoded force"], values["force of the rod"][0]
        if k > 100:
            forces.append(true)
        if np.isfinite(force[0]) and (dragged != 0.0 if way else reach > 12.9):
            low, high = values["decoded azimuth"][1:]
            at = np.rad2deg(np.arctan2(-frame.force[1] - frame.pull[1], -frame.force[0] - frame.pull[0]))
            tilts, tilted = values["decoded tilt"], values["tilt of the force"][0]
            rows.append(
                (
                    force[1] <= true <= force[2],
                    tilts[1] <= tilted <= tilts[2],
                    np.isnan(low) or (at - low) % 360.0 <= high - low,
                    abs(force[0] / true - 1.0),
                    values["load"][0],
                )
            )
    simulation.close()
    found = np.array(rows, dtype=float)
    assert len(found) > 10
    assert (found[:, :3].mean(axis=0) >= 0.95).all(), found[:, :3].mean(axis=0)
    assert found[:, 3].max() > 0.05  # the value itself is off
    if not way:
        assert found[:, 4].mean() > 0.9  # the page says that the load changes
    if way:  # while a rod is dragged slowly its force does not jump: steps end in a balance of the contact, too
        assert (np.abs(np.diff(forces)) < 0.05 * np.mean(forces)).all()


def test_options_that_do_not_belong_together_are_refused(tmp_path: Path, fingertip: TouchableModel) -> None:
    def unused(address: str) -> None:
        raise AssertionError(address)

    with pytest.raises(InputError, match="`decoder` goes with a fingertip, and demo is none"):
        live("demo", decoder=DECODER, port=0, ready=unused)
    with pytest.raises(InputError, match="`experiment` goes with an identified model, and fingertip is a fingertip"):
        live("fingertip", experiment="mr_agar", port=0, ready=unused)
    other = json.loads(DECODER.read_text()) | {"radius_mm": 20.0}
    (tmp_path / "other.json").write_text(json.dumps(other))
    with pytest.raises(InputError, match=r"radius 20 mm, and that of fingertip has 10 mm"):
        touchable_fingertip("fingertip", tmp_path / "other.json")
    with RealTimeLoop(InteractiveSimulation(fingertip.body, fingertip.tools or {})) as loop:
        source = LiveSimulation(fingertip, loop)
        source.command(LiveCommand("cut", edges=(((0.0, 0.0, 20.0), (0.0, 0.0, -5.0)), ((5.0, 0.0, 20.0), (5.0, 0.0, -5.0)))))
        said = ""
        while not said:
            said = source.trouble()
        assert "not cut" in said
        assert source.scene.topology == 0 and not source.scene.cuttable


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_rod_pressed_by_the_mouse_draws_readings_and_decoded_forces(tmp_path: Path) -> None:
    with threadpool_limits(1), served(touchable_fingertip("fingertip")) as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.frame.tool === 0", 60)
        assert page.value("naibuLive.scene.readings.map((r) => r.name)") == [r.name for r in (*LOADS, *DECODED)]
        assert page.value("document.querySelectorAll('.readings canvas').length") == len(
            {r.plot for r in (*LOADS, *DECODED) if not r.states}
        )
        at = page.wait(
            "(() => { const v = naibuLive.view; const b = v.canvas.getBoundingClientRect();"
            " const p = v.tools[0].position.clone().project(v.camera);"
            " const c = [b.left + (p.x + 1) / 2 * b.width, b.top + (1 - p.y) / 2 * b.height]; return v.onTool(...c) ? c : null; })()",
            60,
        )
        page.mouse("mousePressed", *at)
        decoded = "naibuLive.frame.readings[9] > 0.3"
        for k in range(1, 40):  # until the decoder answers: softly, as a hand would
            page.mouse("mouseMoved", at[0] + 0.2 * k, at[1] + 2.0 * k)
            page.value("new Promise((done) => setTimeout(done, 300))")
            if page.value(f"{decoded} || naibuLive.frame.force[2] < -800"):
                break
        page.wait(decoded, 60)
        page.mouse("mouseReleased", at[0], at[1])
        texts = page.value("naibuLive.plots.texts.map((t) => t.textContent)")
        assert texts[0].endswith(" mN") and " N (" in texts[3] and "°" in texts[5], texts
        drawn = page.value(
            "[...document.querySelectorAll('.readings canvas')].map((c) =>"
            " c.getContext('2d').getImageData(0, 0, c.width, c.height).data.filter((v, i) => i % 4 === 3 && v > 0).length)"
        )
        assert min(drawn) > 500
        assert page.console == []
        assert len(page.picture(tmp_path / "fingertip.png").read_bytes()) > 10_000
