"""Figures of a sensing chip: stress along its beams, load envelope, piezoresistance by direction, filters, and designs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from naibu.applications.sensing_chip.analysis import ChipAnalysis
from naibu.applications.sensing_chip.bridge import sensitivity_by_place
from naibu.applications.sensing_chip.design import ChipDesign, beam_points
from naibu.applications.sensing_chip.design_study import DesignStudy
from naibu.applications.sensing_chip.filter_comparison import NAMES, ONLINE, FilterComparison
from naibu.applications.sensing_chip.load_envelope import load_envelope
from naibu.applications.sensing_chip.piezoresistance import Piezoresistance, n_type_silicon, p_type_silicon
from naibu.core.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas
    from matplotlib.projections.polar import PolarAxes

MODELS = ("finite elements, rigid block and clamps", "finite elements, whole chip")
_MPA = 1e-3  # kPa in MPa
_UM = 1e3  # mm in um
_WORK = (("$F_z$", 2, 5000.0, "mN"), ("$M_y$", 4, 800.0, "N µm"))


def stress_along_beam(canvas: Canvas, analysis: ChipAnalysis) -> None:
    """Draw the surface stress along beam A under the printed limits, of closed forms and finite elements, with the resistors."""
    design, beams = analysis.design, analysis.design.closed_forms
    x = np.linspace(0.01, 0.99, 99) * design.beam_length_mm
    points = beam_points(design, "A", x)
    closed = (beams.force_stress(x), beams.bending_stress(x) / beams.moment_stiffness)
    places = (design.force_resistor_mm, design.moment_resistor_mm)
    for axes, (name, load, size, unit), stress, place in zip(canvas.subplots(1, 2), _WORK, closed, places, strict=True):
        axes.plot(_UM * x, _MPA * size * stress, "k--", label="closed form")
        for response, label in zip((analysis.beams, analysis.whole), MODELS, strict=True):
            axes.plot(_UM * x, _MPA * size * response.stress_at(points)[load, :, 0, 0], label=label)
        for centre in (place, design.beam_length_mm - place):
            axes.axvspan(*(_UM * (centre + s * 0.5 * design.resistor_length_mm) for s in (-1, 1)), color="0.85", linewidth=0)
        axes.axhline(0.0, color="k", linewidth=0.5)
        axes.set(title=f"{name} = {size:g} {unit}", xlabel="distance from the clamp (µm)", ylabel="stress along the beam (MPa)")
    canvas.axes[0].legend(fontsize=7)


def placement(canvas: Canvas, analysis: ChipAnalysis) -> None:
    """Draw the sensitivities that resistors at other distances from the ends of the beams would have."""
    design, beams = analysis.design, analysis.design.closed_forms
    length = design.beam_length_mm
    x = np.linspace(0.02, 0.48, 47) * length
    coefficient = 1e3 * design.supply_voltage * design.piezoresistance.longitudinal(design.beam_direction)
    bending = 0.25 * (beams.bending_stress(length - x) - beams.bending_stress(x)) / beams.moment_stiffness
    closed = (0.5 * coefficient * beams.force_stress(x), coefficient * bending)
    found = [sensitivity_by_place(response, x) for response in (analysis.beams, analysis.whole)]
    own = (analysis.of_whole[0, 2], analysis.of_whole[2, 4])
    places = (design.force_resistor_mm, design.moment_resistor_mm)
    for k, (axes, name, unit) in enumerate(zip(canvas.subplots(1, 2), ("$F_z$", "$M_y$"), ("mV/mN", "mV/(N µm)"), strict=True)):
        axes.plot(_UM * x, closed[k], "k--", label="closed form")
        for values, label in zip(found, MODELS, strict=True):
            axes.plot(_UM * x, values[k], label=label)
        axes.plot(_UM * places[k], own[k], "k*", markersize=8, label="resistors of this chip, with their length")
        axes.set(xlabel="distance from the ends (µm)", ylabel=f"sensitivity to {name} ({unit})", ylim=(0.0, None))
    canvas.axes[0].legend(fontsize=7)


def envelope(canvas: Canvas, design: ChipDesign, loads: Sequence[tuple[float, float]] = (), *, marked: str = "loads") -> None:
    """Draw the largest force and moment for several strengths, and loads (mN, N µm) as points."""
    axes = canvas.add_subplot()
    reached = load_envelope(design)
    for factor, style in ((0.5, "C0:"), (1.0, "C0-"), (2.0, "C0--")):
        force, moment = factor * reached.T
        axes.plot(force, moment, style, label=f"strength {factor * design.strength_kpa * 1e-6:g} GPa, moment about x or y")
    diagonal = load_envelope(design, azimuth_deg=45.0).T
    axes.plot(*diagonal, "C1-", label=f"strength {design.strength_kpa * 1e-6:g} GPa, moment about a diagonal")
    if loads:
        axes.plot(*np.array(loads).T, "kx", label=marked)
    axes.set(xlabel="$F_z$ (mN)", ylabel="moment (N µm)", xlim=(0, None), ylim=(0, None))
    axes.legend(fontsize=8)


def piezoresistance_by_direction(canvas: Canvas) -> None:
    """Draw the longitudinal and transverse coefficients in the (001) plane of p- and n-type silicon, as Kanda did."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    # numbers of the circles lie between the lobes
    for k, (name, silicon, clear_deg) in enumerate((("p-type", p_type_silicon(), 78.0), ("n-type", n_type_silicon(), 45.0))):
        axes = cast("PolarAxes", canvas.add_subplot(1, 2, k + 1, projection="polar"))
        along, across = _coefficients(silicon, angle)
        for values, colour, label in ((along, "C0", "longitudinal"), (across, "C1", "transverse")):
            axes.plot(angle, np.where(values >= 0.0, values, np.nan), colour, label=f"{label}, positive")
            axes.plot(angle, np.where(values < 0.0, -values, np.nan), colour + "--", label=f"{label}, negative")
        axes.set_xticks(np.deg2rad([0, 45, 90, 135, 180, 225, 270, 315]), ["[100]", "[110]", "[010]", "", "", "", "", ""])
        axes.set_title(f"{name} silicon (1/TPa)")
        axes.set_rgrids([250, 500, 750, *([1000] if k else [])], angle=clear_deg, fontsize=8)
    canvas.legend(*canvas.axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)


def _coefficients(silicon: Piezoresistance, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    n = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    m = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=1)
    tensor = 1e9 * silicon.tensor()
    along = np.einsum("ijkl,ni,nj,nk,nl->n", tensor, n, n, n, n)
    return np.asarray(along), np.asarray(np.einsum("ijkl,ni,nj,nk,nl->n", tensor, n, n, m, m))


def filters(canvas: Canvas, compared: FilterComparison) -> None:
    """Draw the readings and what the filters make of them: the whole record, the rise and the release."""
    panels = canvas.subplots(1, 3)
    last = compared.times_s[-1]
    release = compared.times_s[int(np.flatnonzero(compared.truth > 0.0)[-1])]
    spans = ((0.0, last), (0.35 * last, 0.35 * last + 0.04 * last), (release - 0.02 * last, release + 0.06 * last))
    shown = (ONLINE[:2], ONLINE[1:], NAMES[1:])
    for axes, span, names in zip(panels, spans, shown, strict=True):
        here = (compared.times_s >= span[0]) & (compared.times_s <= span[1])
        for name in names:
            style = {"color": "0.75", "linewidth": 0.5} if name == NAMES[0] else {"color": f"C{NAMES.index(name)}", "linewidth": 1.0}
            axes.plot(compared.times_s[here], compared.outputs[name][here], label=name, **style)
        axes.plot(compared.times_s[here], compared.truth[here], "k:", linewidth=1.0, label="truth")
        axes.set_xlabel("time (s)")
    for axes, title in zip(panels, ("record", "rise", "release"), strict=True):
        axes.set_title(title)
    panels[0].set_ylabel("reading of $F_z$ (V)")
    panels[0].legend(fontsize=7)
    panels[2].legend(fontsize=7)


def designs(canvas: Canvas, study: DesignStudy, own: DesignStudy) -> None:
    """Draw sensitivity against resonance of all designs with the Pareto front, and the front's beam sizes."""
    left, right = canvas.subplots(1, 2)
    image = left.scatter(
        study.force_sensitivity, 1e-3 * study.force_resonance, c=study.force_limit, s=3, norm="log", cmap="viridis", rasterized=True
    )
    canvas.colorbar(image, ax=left, label="largest $F_z$ (mN)")
    front = np.flatnonzero(study.front("force_sensitivity", "force_resonance"))
    front = front[np.argsort(study.force_sensitivity[front])]
    left.plot(study.force_sensitivity[front], 1e-3 * study.force_resonance[front], "r-", linewidth=1.0, label="Pareto front")
    left.plot(own.force_sensitivity, 1e-3 * own.force_resonance, "k*", markersize=9, label="this chip")
    left.set(xscale="log", yscale="log", xlabel="sensitivity to $F_z$ (mV/mN)", ylabel="resonance along z (kHz)")
    left.legend(fontsize=8)
    for name, values in (("length", study.length_mm), ("width", study.width_mm), ("thickness", study.thickness_mm)):
        right.plot(study.force_sensitivity[front], _UM * values[front], ".-", linewidth=0.8, label=name)
    right.set(xscale="log", xlabel="sensitivity to $F_z$ (mV/mN)", ylabel="size of the beams on the front (µm)")
    right.legend(fontsize=8)
