"""How well the fingertip's finite elements and its decoder do: ``python benchmarks/fingertip.py`` (some five minutes of processor time).

Prints, for ever finer meshes, nodes, processor time and the loads on the chip under a press of 3 N at 20 degrees; then the errors and
intervals of forces that a decoder, trained on the default mesh, gives for presses on a finer mesh with other tilts, frictions and moduli;
the time of a reading; and how much the sensitivity to slip differs between presses.
``--drags`` presses the fingertip of the live page, drags the rod, and prints how far the decoded force is off over the upper end of the
sideways share: in poses from which the share that its intervals allow was chosen, and in others, on which it is tested (five minutes more).
``--quick`` does the same on coarse meshes, ``--record`` writes ``results/fingertip.json``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from records import ResultTable, write_record

from naibu.applications.fingertip.decoder import ForceDecoder, Training, directions, train_decoder, true_contact
from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.fingertip.slip import SlipDetector, train_slip_detector, true_tangential_share
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.electronics import report_readout
from naibu.applications.sensing_chip.filters import noise_gain
from naibu.core.arrays import FloatArray
from naibu.mechanics import RealTimeEngine
from naibu.simulation import InteractiveSimulation
from naibu.simulation.interactive_bodies import FiniteElementBody
from naibu.workflows import TouchableModel
from naibu.workflows.interactive.touchable_fingertip import FORCE_DRAG, touchable_fingertip

MESHES = ((2, 2, 8), (3, 2, 10), (4, 2, 12), (4, 3, 14), (5, 3, 16))
TESTS = (Press(0.0, 3000.0, 0.5), Press(6.0, 3000.0, 0.35), Press(15.0, 3000.0, 0.8), Press(25.0, 3000.0, 0.3), Press(30.0, 3000.0, 0.6))
SLIDES = (Press(15.0, 1000.0, 0.4, 2.0), Press(5.0, 600.0, 0.8, 2.0), Press(25.0, 2000.0, 0.6, -2.5))
AZIMUTH = 37.0
# tilt, azimuth, degrees, and way of the drag, mm
DRAGS_CHOSEN = ((5.0, 80.0, 1.0), (10.0, 310.0, -1.2), (15.0, 160.0, 1.5), (20.0, 0.0, -0.7), (22.0, 215.0, 1.3), (28.0, 95.0, 1.0))
DRAGS_TESTED = ((18.0, 250.0, 1.0), (25.0, 120.0, -1.0), (8.0, 30.0, 1.2), (12.0, 200.0, 0.6))


def convergence(meshes: tuple[tuple[int, int, int], ...]) -> ResultTable:
    """Print one line a mesh."""
    rows = []
    print("mesh          nodes  processor s   depth mm   F_x mN   F_z mN   M_y N um   (3 N at 20 degrees)")
    for mesh in meshes:
        model = FingertipModel.of(Fingertip(), FingertipResolution(*mesh))
        began = time.process_time()
        pressing = model.pressed(Press(20.0, 3000.0))
        seconds = time.process_time() - began
        at = pressing.at_force(np.array([3000.0]))[0]
        depth = float(pressing.interpolated(pressing.depth_mm, np.array([3000.0]))[0])
        print(f"{mesh!s:12} {model.mesh.n_points:6d} {seconds:12.1f} {depth:10.3f} {at[0]:8.2f} {at[2]:8.2f} {at[4]:10.3f}", flush=True)
        rows.append((" x ".join(map(str, mesh)), model.mesh.n_points, *(round(float(v), 3) for v in (depth, at[0], at[2], at[4]))))
    return ResultTable("convergence", ("mesh", "nodes", "depth, mm", "F_x, mN", "F_z, mN", "M_y, N um"), tuple(rows))


def decoding(training_mesh: FingertipResolution, test_mesh: FingertipResolution, chain: ReadingChain) -> tuple[SlipDetector, ResultTable]:
    """Print errors and intervals of decoded presses, without noise and with that of filtered readings; return detector and them."""
    table: list[tuple[float, ...]] = []
    tip, training = Fingertip(), Training()
    model = FingertipModel.of(tip, training_mesh)
    pressings = [model.pressed(press) for press in training.presses(tip)]
    decoder = train_decoder(tip, chain, training, pressings)
    detector = train_slip_detector(decoder, chain, training, pressings, [model.pressed(press) for press in training.slides(tip)])
    other = FingertipModel.of(tip, test_mesh)
    rng, gain = np.random.default_rng(0), noise_gain(0.1)
    for noise in (0.0, gain):
        print(f"\nnoise {noise:.2f} of the electronics'; largest errors from 0.5 to 2.7 N, E = 200 and 240 kPa")
        print("tilt  friction  force %  its 95 % +-  direction deg  95 % cone  place mm  95 %   inside: force, direction, place")
        for press in TESTS:
            pressing, rows = other.pressed(press), []
            for modulus in (200.0, 240.0):
                rows.append(_errors(decoder, chain, pressing.for_modulus(modulus), noise, rng))
            e = np.concatenate(rows)
            inside = [100.0 * float((e[:, k] <= e[:, k + 1]).mean()) for k in (0, 2, 4)]
            most = e.max(axis=0)
            print(
                f"{press.tilt_deg:4.0f} {press.friction:9.2f} {most[0]:8.2f} {most[1]:11.2f} {most[2]:14.2f} {most[3]:10.2f} "
                f"{most[4]:9.2f} {most[5]:5.2f}   {inside[0]:.0f} % {inside[1]:.0f} % {inside[2]:.0f} %",
                flush=True,
            )
            shown = (noise, press.tilt_deg, press.friction, *most, min(inside))
            table.append(tuple(round(float(value), 3) for value in shown))
    columns = (
        "noise", "tilt, degrees", "friction", "force, %", "its 95 %", "direction, degrees", "its 95 %", "place, mm", "its 95 %",
        "least share inside, %",
    )  # fmt: skip
    return detector, ResultTable("decoding", columns, tuple(table))


def _errors(decoder: ForceDecoder, chain: ReadingChain, pressing: Pressing, noise: float, rng: np.random.Generator) -> FloatArray:
    along = np.geomspace(500.0, 2700.0, 12)
    force, tilt, place = true_contact(pressing, along)
    volts = chain.volts(rotated_loads(pressing.at_force(along), AZIMUTH))
    found = decoder.decode(volts + noise * chain.readout.noise_sd * rng.standard_normal(volts.shape), noise_share=max(noise, 1e-6))
    turned = np.full(len(along), AZIMUTH)
    angle = np.arccos(np.clip((found.direction * directions(np.rad2deg(tilt), turned)).sum(axis=1), -1.0, 1.0))
    away = np.linalg.norm(found.position_mm - decoder.radius_mm * directions(np.rad2deg(place), turned), axis=1)
    relative = np.abs(np.log(found.force_mn / force))
    half = 0.5 * np.log(found.force_95[:, 1] / found.force_95[:, 0])
    return np.stack([100 * relative, 100 * half, np.rad2deg(angle), found.cone_95_deg, away, found.position_95_mm], axis=1)


def reading_time(decoder: ForceDecoder) -> float:
    """Print and return the processor time of one reading in a loop, us."""
    reading = np.array([[0.5 * decoder.limits[1], 0.4, -0.6]])
    decoder.decode_loads(reading)
    began = time.process_time()
    for _ in range(20_000):
        decoder.decode_loads(reading)
    took = (time.process_time() - began) / 20_000 * 1e6
    print(f"\none reading: {took:.1f} us")
    return took


def slip(detector: SlipDetector, mesh: FingertipResolution, chain: ReadingChain) -> list[tuple[str, float]]:
    """Print and return how far sideways shares of presses on another mesh that slide are off, with filtered noise."""
    off = 100.0 * detector.sensitivity_error
    print(f"\nchange of M over F_z per sideways share of the force: {detector.sensitivity_mm:.3f} mm, known within {off:.0f} %")
    model, rng, gain = FingertipModel.of(Fingertip(), mesh), np.random.default_rng(0), noise_gain(0.1)
    rows = [("change of the moment over F_z per sideways share, mm", round(detector.sensitivity_mm, 3))]
    for press in SLIDES:
        pressing = model.pressed(press)
        on = pressing.along_rod_mn >= 300.0
        truth = true_tangential_share(pressing)[on]
        volts = chain.volts(rotated_loads(pressing.chip_loads[on], AZIMUTH))
        loads = chain.measured_loads(volts + gain * chain.readout.noise_sd * rng.standard_normal(volts.shape))
        found = detector.followed(np.arange(len(loads)) * 2.0, loads, noise_share=gain)
        error = float(np.nanmax(np.abs(found.size - np.abs(truth - truth[0]))))
        inside = (found.size_95[:, 0] <= np.abs(truth - truth[0])) & (np.abs(truth - truth[0]) <= found.size_95[:, 1])
        shown = f"{press.tilt_deg:.0f} degrees, {press.force_mn:.0f} mN, friction {press.friction:g}"
        told = found.slides(press.friction)[-1]
        print(f"{shown}: largest error {error:.3f} of up to {np.abs(truth).max():.3f}, {inside.sum()} of {on.sum()} inside; slides: {told}")
        rows.append((f"largest error of the sideways share ({shown})", round(error, 3)))
    return rows


def drags() -> None:
    """Print, of drags of the live fingertip, what its intervals must hold."""
    made = touchable_fingertip("fingertip")
    body = made.body
    assert isinstance(body, FiniteElementBody) and isinstance(body.engine, RealTimeEngine) and made.sensor is not None
    made = replace(made, body=replace(body, engine=replace(body.engine, background=False)))  # repeatable
    print(f"largest |error of force| / upper end of the sideways share, of which intervals allow {FORCE_DRAG}")
    print("tilt  azimuth   way mm   ratio               inside: force, tilt")
    for name, poses in (("chosen on", DRAGS_CHOSEN), ("tested on", DRAGS_TESTED)):
        for pose in poses:
            found = _dragged(made, *pose)
            ratio, inside = float(np.nanmax(found[:, 0] / found[:, 1])), 100.0 * found[:, 2:].mean(axis=0)
            print(f"{pose[0]:4.0f} {pose[1]:8.0f} {pose[2]:8.1f} {ratio:10.3f}   {name}   {inside[0]:.0f} % {inside[1]:.0f} %", flush=True)


def _dragged(made: TouchableModel, tilt: float, azimuth: float, way: float) -> FloatArray:
    """Return of frames of a drag by `way`, mm, at 1 mm/s: relative error of force, upper end of the share, force and tilt inside (n, 4)."""
    simulation = InteractiveSimulation(made.body, made.tools or {})
    sensor = replace(made.sensor)
    t, a = np.deg2rad(tilt), np.deg2rad(azimuth)
    outwards = np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
    across = np.array([np.cos(t) * np.cos(a), np.cos(t) * np.sin(a), -np.sin(t)])
    simulation.take("rod")
    reach, dragged, last, rows = 15.5, 0.0, 0.0, []
    for k in range(200):
        simulation.move(reach * outwards + dragged * across)
        simulation.aim(-outwards)
        frame = simulation.advance()
        read = dict(zip((r.name for r in sensor.readings), sensor.at(frame).copy(), strict=True))
        passed, last = frame.time_s - last, frame.time_s
        reach = 14.2 if k == 30 else max(12.9, reach - 2.0 * passed) if k > 30 else reach
        if k > 100:
            dragged += float(np.clip(way - dragged, -passed, passed))
        (value, low, high), true = read["decoded force"], read["force of the rod"][0]
        if dragged != 0.0 and np.isfinite(value):
            tilts = read["decoded tilt"]
            rows.append((abs(value / true - 1.0), read["decoded sideways share"][2], low <= true <= high,
                         tilts[1] <= read["tilt of the force"][0] <= tilts[2]))  # fmt: skip
    simulation.close()
    return np.array(rows, dtype=float)


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--quick", action="store_true", help="coarse meshes")
    part.add_argument("--record", action="store_true", help="write results/fingertip.json")
    parser.add_argument("--drags", action="store_true", help="drag the rod on the fingertip of the live page instead")
    options = parser.parse_args()
    if options.drags:
        drags()
        return
    converged = convergence(MESHES[:2] if options.quick else MESHES)
    chain = ReadingChain.of_chip(assumed_chip(), report_readout())
    of_training, of_test = (MESHES[1], MESHES[2]) if options.quick else (MESHES[3], MESHES[4])
    detector, decoded = decoding(FingertipResolution(*of_training), FingertipResolution(*of_test), chain)
    rows: list[tuple[str, float]] = [("processor time of a reading, us", round(reading_time(detector.decoder), 1))]
    rows += slip(detector, FingertipResolution(*of_test), chain)
    if options.record:
        write_record("fingertip", (converged, decoded, ResultTable("readings", ("figure", "value"), tuple(rows))))


if __name__ == "__main__":
    main()
