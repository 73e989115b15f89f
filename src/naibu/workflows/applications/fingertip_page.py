"""Page of a simulated fingertip: the deformed finger, forces on the chip and readings, and what the decoder makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.fingertip.decoder import DecodedForces, ForceDecoder, directions, true_contact
from naibu.applications.fingertip.pressing import FingertipModel, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.fingertip.slip import SlipDetector
from naibu.applications.sensing_chip.filters import noise_gain
from naibu.core.arrays import BoolArray, FloatArray
from naibu.reproduction.chapter6 import fingertip_figures
from naibu.reproduction.chapter6.contact_comparison import theories_section
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table
from naibu.workflows.applications.fingertip_study import PreparedFingertip

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_POOR_PERCENT, _POOR_DEG = 5.0, 2.0
_CHECKED = 12  # forces of every press that are decoded


@dataclass(frozen=True, slots=True, eq=False)
class FingertipResults:
    """What was computed of a fingertip.

    Attributes
    ----------
    model : FingertipModel
        The finite elements.
    chain : ReadingChain
        The chip and its electronics.
    names, azimuths_deg, pressings, loads : tuple
        Of every press: name, azimuth, what it did in the plane of its tilt, and the loads (n, 6) on the chip in its frame.
    decoder : ForceDecoder, optional
        Where the file asks for one.
    detector : SlipDetector, optional
        With it.
    filter_share : float
        r of the first-order filter.
    times_s, recorded_volts : ndarray, shape (t,) and (t, 3)
        Filtered readings of the last press.
    """

    model: FingertipModel
    chain: ReadingChain
    names: tuple[str, ...]
    azimuths_deg: tuple[float, ...]
    pressings: tuple[Pressing, ...]
    loads: tuple[FloatArray, ...]
    decoder: ForceDecoder | None
    detector: SlipDetector | None
    filter_share: float
    times_s: FloatArray
    recorded_volts: FloatArray


def fingertip_sections(study: PreparedFingertip, results: FingertipResults) -> tuple[Section, ...]:
    """Return the sections of the page."""
    sections = [_presses(study, results), theories_section(results.model.fingertip, results.names, results.pressings)]
    if results.decoder is not None:
        sections.insert(1, _decoding(results, results.decoder))
    curves = tuple(_curve(results, k) for k in range(len(results.names)))
    return (*sections, Section("Curves of the presses", (), curves))


def fingertip_cards(results: FingertipResults) -> tuple[Card, ...]:
    """Return the answers at the head of the page: the largest press, what the chip then feels, and how well readings are decoded."""
    k = int(np.argmax([p.along_rod_mn[-1] for p in results.pressings]))
    pressing, on_chip = results.pressings[k], results.loads[k][-1, 2:5]
    cards = [
        Card(
            "Largest force along the rod",
            f"{1e-3 * pressing.along_rod_mn[-1]:.3g} N",
            f"{results.names[k]}, {pressing.depth_mm[-1]:.3g} mm deep",
        ),
        Card("Force on the chip then", f"{on_chip[0]:.3g} mN", "F_z"),
        Card("Moment on the chip then", f"{np.hypot(*on_chip[1:]):.3g} N µm", "of M_x and M_y"),
    ]
    if results.decoder is not None:
        left = 100.0 * float(results.decoder.spread[0])
        cards.append(Card("Force that the decoder leaves unexplained", f"{left:.2g} %", "standard deviation over its training"))
    return tuple(cards)


def _presses(study: PreparedFingertip, results: FingertipResults) -> Section:
    rows: list[tuple[Cell, ...]] = []
    felt: list[tuple[Cell, ...]] = []
    all_volts = [results.chain.volts(loads) for loads in results.loads]
    for k, (pressing, loads, volts) in enumerate(zip(results.pressings, results.loads, all_volts, strict=True)):
        over = [name for name, at in zip(fingertip_figures.CHANNELS, np.any(results.chain.saturated(volts), axis=0), strict=True) if at]
        rows.append(
            (results.names[k], pressing.press.tilt_deg, results.azimuths_deg[k], pressing.press.friction,
             1e-3 * float(pressing.along_rod_mn[-1]), float(pressing.depth_mm[-1]), float(pressing.contact_radius_mm[-1]))
        )  # fmt: skip
        felt.append((results.names[k], *(float(v) for v in loads[-1, 2:5]), *(float(v) for v in volts[-1]), ", ".join(over) or "none"))
    columns = ("press", "tilt, degrees", "azimuth, degrees", "friction", "force along the rod, N", "depth, mm", "contact radius, mm")
    table = Table("Presses", columns, tuple(rows), caption=f"{study.fingertip.diameter_mm:g} mm fingertip, at the end of each press.")
    note = "At the end of each press, without noise. A saturated channel exceeds the converter's range: its reading is not to be used."
    felt_columns = ("press", "F_z, mN", "M_x, N µm", "M_y, N µm", "reading F_z, V", "reading M_x, V", "reading M_y, V", "saturated")
    on_chip = Table("On the chip", felt_columns, tuple(felt), note=note)
    last = results.pressings[-1]
    forces = [1e-3 * p.along_rod_mn for p in results.pressings]
    moments = {name: volts[:, 1:] for name, volts in zip(results.names, all_volts, strict=True)}
    figures = (
        Figure("Finger", f"Section in the plane of the tilt under the last press, {results.names[-1]}.",
               lambda canvas: fingertip_figures.section(canvas, results.model, last), (9.0, 5.0)),
        Figure("Readings", "Without noise, over the force along the rod.",
               lambda canvas: fingertip_figures.readings_over_force(canvas, forces, all_volts, results.names), (11.0, 3.6)),
        Figure("Moments", "M_y over M_x.", lambda canvas: fingertip_figures.moments(canvas, moments), (7.0, 4.0)),
    )  # fmt: skip
    return Section("Presses", (), (table, on_chip), figures)


def _curve(results: FingertipResults, k: int) -> Table:
    pressing, loads = results.pressings[k], results.loads[k]
    volts = results.chain.volts(loads)
    rows = tuple(
        (float(d), float(s), 1e-3 * float(f), *(float(v) for v in load[[2, 3, 4]]), *(float(v) for v in volt))
        for d, s, f, load, volt in zip(pressing.depth_mm, pressing.slide_mm, pressing.along_rod_mn, loads, volts, strict=True)
    )
    columns = ("depth, mm", "slide, mm", "force, N", "F_z, mN", "M_x, N µm", "M_y, N µm", "F_z, V", "M_x, V", "M_y, V")
    return Table(f"Curve of {results.names[k]}", columns, rows)


def _decoding(results: FingertipResults, decoder: ForceDecoder) -> Section:
    found: list[DecodedForces] = []
    forces: list[FloatArray] = []
    tilts: list[FloatArray] = []
    rows: list[tuple[Cell, ...]] = []
    gain = noise_gain(results.filter_share)
    rng = np.random.default_rng(0)
    for k, pressing in enumerate(results.pressings):
        along = np.linspace(0.08, 1.0, _CHECKED) * min(float(pressing.along_rod_mn.max()), pressing.press.force_mn)
        force, tilt, _ = true_contact(pressing, along)
        loads = rotated_loads(pressing.at_force(along), results.azimuths_deg[k])
        noise = gain * results.chain.readout.noise_sd * rng.standard_normal((len(along), 3))
        answer = decoder.decode(results.chain.volts(loads) + noise, noise_share=gain)
        ok = answer.answered
        angle = _angle(answer, directions(np.rad2deg(tilt), np.full(len(tilt), results.azimuths_deg[k])))
        inside = (answer.force_95[:, 0] <= force) & (force <= answer.force_95[:, 1])
        upper, held = ok & (along > 0.3 * along[-1]), ok & (angle <= answer.cone_95_deg)
        rows.append(
            (results.names[k], f"{ok.sum()} of {len(ok)}", _most(100.0 * np.abs(answer.force_mn / force - 1.0), upper),
             _most(angle, upper), _most(answer.cone_95_deg, upper), int((inside & ok).sum()), int(held.sum()))
        )  # fmt: skip
        found.append(answer)
        forces.append(force)
        tilts.append(np.rad2deg(tilt))
    table = Table(
        "Decoded presses",
        ("press", "answered", "largest error of the force, %", "largest error of the direction, degrees", "largest 95 % cone, degrees",
         "forces inside their intervals", "directions inside their cones"),
        tuple(rows), caption="Readings with filtered noise; errors above 30 % of the largest force.",
        note="Readings beyond the training are not answered. The decoder supposes a rod that presses towards the centre; sideways drag is "
        "taken for another direction. Intervals hold noise, the ranges of friction and modulus, and the stated model error.",
    )  # fmt: skip

    def draw(canvas: Canvas) -> None:
        fingertip_figures.decoded(canvas, found, forces, tilts)

    figure = Figure("Decoded", "Decoded over true values, with 95 % intervals.", draw, (10.0, 4.0))
    left, tilt_left = 100.0 * float(decoder.spread[0]), float(np.rad2deg(decoder.spread[1]))
    fit = f"The decoder leaves {left:.2g} % of the force and {tilt_left:.2g} degrees of the training unexplained (standard deviations)."
    if left > _POOR_PERCENT or tilt_left > _POOR_DEG:
        fit += " That is much: refine the mesh, or add tilts to the training."
    if results.detector is not None:
        moved, off = results.detector.sensitivity_mm, 100.0 * results.detector.sensitivity_error
        fit += f" Drag moves the moment over F_z by {moved:.3g} mm times the sideways share of the force (known within {off:.2g} %)."
    return Section("Forces decoded from the readings", (fit,), (table,), (figure,))


def _angle(answer: DecodedForces, truth: FloatArray) -> FloatArray:
    return np.asarray(np.rad2deg(np.arccos(np.clip((answer.direction * truth).sum(axis=1), -1.0, 1.0))))


def _most(values: FloatArray, chosen: BoolArray) -> float | None:
    return float(values[chosen].max()) if chosen.any() else None
