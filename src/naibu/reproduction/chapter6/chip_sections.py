"""Tables and sections about one sensing chip, for the chapter and for the page of a user's design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.applications.sensing_chip.analysis import ChipAnalysis
from naibu.applications.sensing_chip.bridge import BRIDGES, closed_form_sensitivities, crosstalk, sensitivity_matrix
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import ChipDesign
from naibu.applications.sensing_chip.design_study import DesignStudy, study_designs
from naibu.applications.sensing_chip.electronics import Readout
from naibu.applications.sensing_chip.filter_comparison import JUMP, NAMES, ONLINE, compare_filters
from naibu.applications.sensing_chip.filters import noise_gain, ramp_lag, time_constant
from naibu.applications.sensing_chip.finite_elements import LOADS, solve_chip
from naibu.applications.sensing_chip.load_envelope import load_limits
from naibu.core.arrays import FloatArray
from naibu.reproduction.chapter6 import chip_figures
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

UNITS = ("mN", "mN", "mN", "N µm", "N µm", "N µm")
_CHECKED = 3  # designs of the front that finite elements check


def model_table(analysis: ChipAnalysis) -> Table:
    """Return stiffnesses, resonances and stresses by closed forms and finite elements."""
    design, beams, whole, forms = analysis.design, analysis.beams, analysis.whole, analysis.design.closed_forms
    mass = design.block_mass_kg
    along_z = (float(np.sqrt(forms.force_stiffness / mass)), float(np.sqrt(forms.moment_stiffness / design.block_inertia)))
    rows: list[tuple[Cell, ...]] = [
        ("F_z over displacement, N/mm", *_thousandth(forms.force_stiffness, beams.force_stiffness, whole.force_stiffness)),
        ("M_y over rotation, mN m/rad", *_thousandth(forms.moment_stiffness, beams.moment_stiffness, whole.moment_stiffness)),
        ("resonance along z, kHz", *_thousandth(along_z[0] / (2 * np.pi), beams.resonances_hz[0], whole.resonances_hz[0])),
        ("resonance of tilt, kHz", *_thousandth(along_z[1] / (2 * np.pi), beams.resonances_hz[1], whole.resonances_hz[1])),
    ]
    return Table(
        "Stiffness and resonance",
        ("quantity", "closed form", "finite elements, rigid block and clamps", "finite elements, whole chip"),
        tuple(rows),
        note="The closed forms neglect the beams' shear, which counts for short beams, and the compliance of block and frame at their "
        "ends, which counts more. Resonances of finite elements are upper bounds, of block, pillar and beams; "
        "those of the closed forms neglect "
        "the beams' mass, and the tilt's coupling to lateral motion.",
    )


def _thousandth(*values: float | FloatArray) -> tuple[float, ...]:
    return tuple(1e-3 * float(value) for value in values)


def sensitivity_table(analysis: ChipAnalysis, paper: Sequence[float] | None = None) -> Table:
    """Return the sensitivities of the three bridges, with printed ones where they are given."""
    columns = [
        "bridge",
        *(["paper"] if paper else []),
        "closed form",
        "finite elements, rigid block and clamps",
        "finite elements, whole chip",
    ]
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(BRIDGES):
        unit = "mV/mN" if k == 0 else "mV/(N µm)"
        printed: tuple[Cell, ...] = (float(paper[k]),) if paper else ()
        values = (analysis.closed[k], analysis.of_beams[k, 2 + k], analysis.of_whole[k, 2 + k])
        rows.append((f"{name}, {unit}", *printed, *(float(v) for v in values)))
    return Table(
        "Sensitivity",
        tuple(columns),
        tuple(rows),
        note="The closed forms count the stress along the beams only; finite elements count the whole stress tensor, averaged over the "
        "resistors, through the piezoresistance tensor.",
    )


def placement_figure(analysis: ChipAnalysis) -> Figure:
    """Return the sensitivities that other places of the resistors would give."""
    caption = "Sensitivity of resistors at other distances from both ends of the beams, on their axes."
    return Figure("Placement", caption, lambda canvas: chip_figures.placement(canvas, analysis), (10.0, 3.6))


def crosstalk_tables(analysis: ChipAnalysis, full_scale: Sequence[float]) -> tuple[Table, Table]:
    """Return output at full scale of every load over that of the bridge's own load, aligned and with a shifted mask, %."""
    columns = ("bridge", *(f"{name} = {size:g} {unit}" for name, size, unit in zip(LOADS, full_scale, UNITS, strict=True)))
    tables = []
    dx, dy = (1e3 * s for s in analysis.shift_mm)
    for title, matrix, caption in (
        ("Crosstalk", analysis.of_whole, "Resistors on the beams' axes, whole chip, %."),
        ("Crosstalk, shifted mask", analysis.misaligned, f"All resistors shifted by {dx:g} µm along x and {dy:g} µm along y, %."),
    ):
        share = 100.0 * crosstalk(matrix, full_scale)
        rows: tuple[tuple[Cell, ...], ...] = tuple(
            (name, *(round(float(v), 3) + 0.0 for v in row)) for name, row in zip(BRIDGES, share, strict=True)
        )
        tables.append(Table(title, columns, rows, caption=caption))
    return tables[0], tables[1]


def readout_section(analysis: ChipAnalysis, readout: Readout, share: float, seed: int) -> Section:
    """Return what the electronics can measure, and the filters side by side."""
    sensitivities, limits = analysis.sensitivities, load_limits(analysis.design)
    measurable, noise = readout.measurable(sensitivities), readout.load_noise(sensitivities)
    rows = tuple(
        (
            f"{name}, {'mN' if k == 0 else 'N µm'}",
            readout.gains[k],
            float(measurable[k]),
            float(limits[k]),
            float(noise[k]),
            float(noise[k] * noise_gain(share)),
            float(1e3 * readout.step / (readout.gains[k] * sensitivities[k])),
        )
        for k, name in enumerate(BRIDGES)
    )
    table = Table(
        "Readout",
        ("channel", "gain", "measurable", "borne by the beams", "noise SD", "noise SD, filtered", "step of the converter"),
        rows,
        caption=f"Converter of {readout.adc_bits} bits, ±{readout.adc_limit:g} V; sensitivities of the whole chip.",
        note="Widths of noise from peak to peak are taken as six standard deviations (assumed).",
    )
    compared = compare_filters(readout, share, seed=seed)
    filters = Table(
        "Filters",
        ("filter", "use", "noise SD, V", "noise over unfiltered", "lag behind a ramp, samples", "overshoot, %", "RMS error, V"),
        tuple(
            (
                name,
                "online" if name in ONLINE else "offline",
                compared.noise_sd[name],
                compared.noise_sd[name] / compared.noise_sd[NAMES[0]],
                round(compared.lag_samples[name], 3) + 0.0,
                round(100.0 * compared.overshoot[name], 3),
                compared.rms_error[name],
            )
            for name in NAMES
        ),
        note=f"The first-order filter with r = {share:g} lets through {noise_gain(share):.3f} of white noise; its time constant is "
        f"{time_constant(share):.2f} samples, its lag behind a ramp {ramp_lag(share):.3g} samples. The Kalman filter is tuned to let "
        "through as "
        f"much: it follows ramps without lag, and overshoots where the load jumps, unless it starts anew where a reading is {JUMP:g} "
        "standard "
        "deviations off. The offline filters need the whole recording.",
    )
    text = (
        f"The amplified signal of {readout.gains[0]:g} times {sensitivities[0]:.3g} mV/mN reaches the end of the converter at "
        f"{measurable[0]:.3g} mN, {100 * measurable[0] / limits[0]:.2g} % of what the beams bear.",
    )
    figure = Figure(
        "Filters",
        "Readings of F_z while a load rises, stays and is taken away.",
        lambda canvas: chip_figures.filters(canvas, compared),
        (10.0, 3.2),
    )
    return Section("Readout and filters", text, (table, filters), (figure,))


def study_section(design: ChipDesign, study: DesignStudy, *, check: bool = True) -> Section:
    """Return designs with other beams, their Pareto front, and finite elements of some of them."""
    own = study_designs(design, [design.beam_length_mm], [design.beam_width_mm], [design.beam_thickness_mm])
    front = np.flatnonzero(study.front("force_sensitivity", "force_resonance"))
    front = front[np.argsort(study.force_sensitivity[front])]
    chosen = front[np.unique(np.linspace(0, len(front) - 1, _CHECKED + 2).round().astype(int))[1:-1]] if len(front) > 2 else front
    rows = [("this chip", *_figures(own, 0, design, check=check))]
    rows += [("on the front", *_figures(study, int(k), design, check=check)) for k in chosen]
    units = (
        "L, µm", "w, µm", "t, µm", "F_z, mV/mN", "M_y, mV/(N µm)", "largest F_z, mN", "largest M_y, N µm", "stiffness along z, N/mm",
        "resonance, kHz", "stiffness over closed form", "F_z over closed form",
    )  # fmt: skip
    product = float(np.median(study.force_sensitivity * study.force_limit))
    text = (
        f"{len(study.length_mm)} combinations of beam length, width and thickness by the closed forms; resistors keep their relative "
        "places. "
        f"Sensitivity times range is {product:.0f} mV whatever the beams: it is set by strength, piezoresistance, supply and place of the "
        "resistors. What the sizes decide is how stiff a chip of given sensitivity is: short beams resonate highest.",
    )
    table = Table("Designs", ("design", *units), tuple(rows), caption="Finite elements: beams between rigid block and clamps.")
    figure = Figure("Designs", "Sensitivity against resonance.", lambda canvas: chip_figures.designs(canvas, study, own), (10.0, 4.0))
    return Section("Design study", text, (table,), (figure,))


def _figures(study: DesignStudy, k: int, base: ChipDesign, *, check: bool) -> tuple[Cell, ...]:
    scale = float(study.length_mm[k]) / base.beam_length_mm
    ratios: tuple[float | None, float | None] = (None, None)
    if check:
        design = replace(
            base,
            beam_length_mm=float(study.length_mm[k]),
            beam_width_mm=float(study.width_mm[k]),
            beam_thickness_mm=float(study.thickness_mm[k]),
            force_resistor_mm=scale * base.force_resistor_mm,
            moment_resistor_mm=scale * base.moment_resistor_mm,
            resistor_length_mm=scale * base.resistor_length_mm,
        )
        response = solve_chip(design, ChipResolution(along=10, across=2, through=2), whole=False)
        ratios = (
            response.force_stiffness / float(study.force_stiffness[k]),
            float(sensitivity_matrix(response)[0, 2] / closed_form_sensitivities(design)[0]),
        )
    return (
        1e3 * float(study.length_mm[k]), 1e3 * float(study.width_mm[k]), 1e3 * float(study.thickness_mm[k]),
        float(study.force_sensitivity[k]), float(study.moment_sensitivity[k]), float(study.force_limit[k]), float(study.moment_limit[k]),
        1e-3 * float(study.force_stiffness[k]), 1e-3 * float(study.force_resonance[k]), *ratios,
    )  # fmt: skip
