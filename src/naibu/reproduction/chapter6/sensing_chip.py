"""The micro force and moment sensor of chapter 6 :cite:p:`hirai2008`: its equations, table 6.1, electronics and filter."""

from __future__ import annotations

import numpy as np

from naibu.applications.sensing_chip.analysis import ChipAnalysis
from naibu.applications.sensing_chip.closed_forms import CrossBeam, orthotropic_torsion_stiffness
from naibu.applications.sensing_chip.design import ChipDesign, beam_points
from naibu.applications.sensing_chip.design_study import DesignStudy, study_designs
from naibu.applications.sensing_chip.electronics import report_readout
from naibu.applications.sensing_chip.fillets import filleted_end
from naibu.applications.sensing_chip.load_envelope import largest_stress, load_limits, surface_stress
from naibu.reproduction.chapter6 import chip_figures
from naibu.reproduction.chapter6.chip_sections import (
    crosstalk_tables,
    model_table,
    placement_figure,
    readout_section,
    sensitivity_table,
    study_section,
)
from naibu.reproduction.chapter6.fillet_section import fillet_figure, fillet_table
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

SHARE = 0.1  # r of equation (6.1)
FILLETS_MM = (0.01, 0.02, 0.04)  # radii, which the report does not print


def chip_sections(analysis: ChipAnalysis, seed: int) -> tuple[Section, ...]:
    """Return the sections on the chip.

    Parameters
    ----------
    analysis : ChipAnalysis
        Of the assumed chip.
    seed : int
        Of the noise.
    """
    design = analysis.design
    return (
        _assumptions(design),
        _equations(analysis),
        _piezoresistance(design),
        _specification(analysis),
        _electronics(analysis, seed),
        study_section(design, designs_around(design)),
    )


def designs_around(design: ChipDesign, count: int = 21) -> DesignStudy:
    """Return designs whose beams are 0.5 to 2.5 times as long, and 0.3 to 2 times as wide and thick, in `count` steps each."""
    return study_designs(
        design,
        design.beam_length_mm * np.geomspace(0.5, 2.5, count),
        np.minimum(design.beam_width_mm * np.geomspace(0.3, 2.0, count), 2.0 * design.block_half_width_mm),
        design.beam_thickness_mm * np.geomspace(0.3, 2.0, count),
    )


def _assumptions(d: ChipDesign) -> Section:
    um = 1e3
    rows: tuple[tuple[Cell, ...], ...] = (
        ("beams L × w × t, µm", f"{um * d.beam_length_mm:g} × {um * d.beam_width_mm:g} × {um * d.beam_thickness_mm:g}", "sensitivities"),
        ("block half width c, µm", um * d.block_half_width_mm, "c = L / 2"),
        ("resistors of F_z, of M_x and M_y: distance from the clamp, µm", f"{um * d.force_resistor_mm:g}, {um * d.moment_resistor_mm:g}",
         "sensitivities; both printed limits stress the beams alike"),
        ("supply, V", d.supply_voltage, "usual"),
        ("piezoresistance of <110>, along and across, 1/TPa", "718, −663", "lightly doped p-type silicon (Smith 1954)"),
        ("Young's modulus of <110>, shear modulus, GPa", "169, 50.9", "silicon (Wortman and Evans 1965)"),
        ("strength, GPa", 1e-6 * d.strength_kpa, "etched silicon beams bear 1 to 8 GPa"),
        ("block height, frame, pillar, µm", f"{um * d.block_height_mm:g}, {um * d.frame_width_mm:g}, {um * d.pillar_width_mm:g}",
         "chip of 2 × 2 mm²"),
        ("layout of the bridges of M_x and M_y", "four resistors each", "Fig. 7(b) names no places"),
        ("converter's range, V; readings a second", "±10; 100", "AD12-16(PCI)EV has 12 bits"),
    )  # fmt: skip
    text = (
        "Chapter 6 and the papers in it print equations, a table of strength and sensitivity, gains and the noise. They do not print the "
        "chip's dimensions, its supply, the places of the resistors, nor the silicon's constants. What is assumed here stands in the "
        "table.",
        "The dimensions are chosen so that the closed forms give both printed sensitivities, with the same largest stress at either of the "
        "printed limits; the ratios c / L and w / t and the place of the moments' resistors remain free.",
        "Of the soft fingertip around the chip the report prints diameters and modulus; its package and the friction are assumed below.",
    )
    return Section("What is printed, and what is assumed", text, (Table("Assumptions", ("quantity", "value", "why"), rows),))


def _equations(analysis: ChipAnalysis) -> Section:
    forms = analysis.design.closed_forms
    figure = Figure(
        "Figures 3 and 5 (papers)",
        "Stress along beam A under the printed limits of F_z and M_y; shaded: resistors.",
        lambda canvas: chip_figures.stress_along_beam(canvas, analysis),
        (10.0, 3.8),
    )
    text = (
        "The equations follow from the bending, twisting and stretching of four clamped beams around a rigid block. Three of them have "
        "misprints, which algebra reveals. Every equation is compared with three-dimensional finite elements of anisotropic silicon: of "
        "the "
        "beams alone, between a rigid block and rigid clamps, and of the whole chip, whose frame is fixed below and whose block is moved "
        "by "
        "the pillar.",
        "The stresses in the middle of the beams agree within a few per cent; those under a moment, and all stiffnesses, depend on the "
        "shear "
        "of the short beams and on the compliance of frame and block, which the closed forms neglect.",
    )
    tables = (_misprints(forms, 800.0), _checked(analysis), model_table(analysis))
    return Section("Closed forms (1) to (22)", text, tables, (figure,))


def _misprints(forms: CrossBeam, moment: float) -> Table:
    theta = moment / float(forms.moment_stiffness)
    c, length, t, e = (float(v) for v in (forms.half_width, forms.length, forms.thickness, forms.young_modulus))
    edge, whole = (e * float(forms.axial_strain(theta, bending=b)) for b in (False, True))
    smallest, largest = (float(forms.stress(at, theta)) for at in (0.0, length))
    x0 = float(forms.stress_free_point(theta))
    printed_x0 = length / (2 * c + length) * ((length + 3 * c) / 3 + length * c * theta / (3 * t))
    rows: tuple[tuple[Cell, ...], ...] = (
        ("(8)", "dx = c θ²", "dx = c θ² / 2", "dx, µm", 1e3 * c * theta**2, 0.5e3 * c * theta**2),
        (
            "(11)",
            "F_RX = w t E c θ² / I",
            "w t E c θ² / (2 L)",
            "unit of area / I: no force",
            None,
            edge * float(forms.width) * t,
        ),
        ("(18)", "E c θ² / L", "E c θ² / (2 L)", "stress, MPa", 2e-3 * edge, 1e-3 * edge),
        ("(20)", "... + E c θ² / L", "... + E c θ² / (2 L)", "stress at x = 0, MPa", 1e-3 * (smallest + edge), 1e-3 * smallest),
        ("(21)", "... + E c θ² / L", "... + E c θ² / (2 L)", "stress at x = L, MPa", 1e-3 * (largest + edge), 1e-3 * largest),
        ("(22)", "... + L c θ / (3 t)", "... − L c θ / (6 t)", "stress-free point, µm", 1e3 * printed_x0, 1e3 * x0),
    )
    return Table(
        "Misprints",
        ("equation", "printed", "corrected", "quantity at M_y = 800 N µm", "printed", "corrected"),
        rows,
        note="F_RX is in mN. The corrected (8) still neglects that a bent beam is shorter, by (3 c² / (5 L) + c / 10 + L / 15) θ²: "
        f"with it the stretch adds {1e-3 * whole:.3g} MPa rather than {1e-3 * edge:.3g}, "
        "which finite elements at finite strain confirm within "
        "1 %. For c = L / 2 the printed (8) is, by accident, within 4 % of that. All of this is below 1 % of the stress.",
    )


def _checked(analysis: ChipAnalysis) -> Table:
    forms, design, beams, whole = analysis.design.closed_forms, analysis.design, analysis.beams, analysis.whole
    x = np.array([0.3, 0.7]) * design.beam_length_mm
    points = beam_points(design, "A", x)
    rotation = 1.0 / beams.moment_stiffness
    a, d = beams.clamp_loads[4, 0], beams.clamp_loads[4, 3]
    moment_at_block = abs(a[4]) - abs(a[2]) * design.beam_length_mm
    torsion = orthotropic_torsion_stiffness(
        design.beam_width_mm, design.beam_thickness_mm, float(forms.shear_modulus),
        design.crystal.shear_modulus(design.beam_direction, design.wafer_normal),
    )  # fmt: skip

    of_force, of_moment = (
        [[float(1e-3 * load * r.stress_at(points)[k, at, 0, 0]) for r in (beams, whole)] for at in (0, 1)]
        for k, load in ((2, 1e3), (4, 8e2))
    )
    closed_force = [float(forms.force_stress(at)) for at in x]
    closed_moment = [0.8 * float(forms.bending_stress(at) / forms.moment_stiffness) for at in x]
    rows: list[tuple[Cell, ...]] = [
        ("(1) stress at 0.3 L, MPa/N", closed_force[0], *of_force[0]),
        ("(1) stress at 0.7 L, MPa/N", closed_force[1], *of_force[1]),
        ("(4) deflection, µm/N", *(1e6 / float(k) for k in (forms.force_stiffness, beams.force_stiffness, whole.force_stiffness))),
        ("(9) F_RZ, N per rad", 1e-3 * float(forms.end_force), 1e-3 * abs(a[2]) / rotation, None),
        ("(10) M_RY, mN m per rad", 1e-3 * float(forms.end_moment), 1e-3 * abs(moment_at_block) / rotation, None),
        ("(12), (13) T_RY, mN m per rad", 1e-3 * float(forms.end_torque), 1e-3 * abs(d[4]) / rotation, None),
        ("(12) with both shear moduli", 1e-3 * torsion / design.beam_length_mm, 1e-3 * abs(d[4]) / rotation, None),
        (
            "(15) θ, mrad at 800 N µm",
            *(8e5 / float(k) for k in (forms.moment_stiffness, beams.moment_stiffness, whole.moment_stiffness)),
        ),
        ("(19) stress at 0.3 L, MPa at 800 N µm", closed_moment[0], *of_moment[0]),
        ("(19) stress at 0.7 L, MPa at 800 N µm", closed_moment[1], *of_moment[1]),
        (
            "(22) stress-free point, µm",
            1e3 * float(forms.stress_free_point()),
            _stress_free(analysis, "beams"),
            _stress_free(analysis, "whole"),
        ),
    ]
    return Table(
        "Equations and finite elements",
        ("equation", "closed form", "finite elements, rigid block and clamps", "finite elements, whole chip"),
        tuple(rows),
        note="Slender beams, for which the equations are meant, agree within 1 to 2.5 %: tests/applications/sensing_chip. (12) has one "
        "shear modulus, and neglects that the clamped ends cannot warp.",
    )


def _stress_free(analysis: ChipAnalysis, which: str) -> float:
    design = analysis.design
    x = np.linspace(0.2, 0.8, 121) * design.beam_length_mm
    response = analysis.beams if which == "beams" else analysis.whole
    return float(1e3 * np.interp(0.0, response.stress_at(beam_points(design, "A", x))[4, :, 0, 0], x))


def _piezoresistance(design: ChipDesign) -> Section:
    text = (
        "Piezoresistors of p-type silicon along <110> change their resistance by 718 parts per million per MPa along, and −663 across the "
        "current. Along <100> they would be eleven times less sensitive. Since the longitudinal strain of <110> beams in a (001) wafer "
        "contracts them sideways by only 0.064, little transverse stress arises at the clamps, and it costs a few per cent of the signal.",
    )
    figure = Figure(
        "Piezoresistance", "Coefficients in the (001) plane, after Kanda (1982).", chip_figures.piezoresistance_by_direction, (9.0, 4.4)
    )
    rows = tuple(
        (f"<{''.join(map(str, n))}>", 1e9 * design.piezoresistance.longitudinal(n), 1e-6 * design.crystal.young_modulus(n))
        for n in ((1, 0, 0), (1, 1, 0), (1, 1, 1))
    )
    table = Table("Directions", ("direction", "longitudinal piezoresistance, p-type, 1/TPa", "Young's modulus, GPa"), rows)
    return Section("Piezoresistance in the axes of the crystal", text, (table,), (figure,))


def _electronics(analysis: ChipAnalysis, seed: int) -> Section:
    readout = report_readout()
    section = readout_section(analysis, readout, SHARE, seed)
    _, (strength, sensitivity) = printed_table("6.1")
    full_mv = float(strength[1]) * float(sensitivity[1])
    end_mn = 1e3 * readout.adc_limit / (readout.gains[0] * float(sensitivity[1]))
    text = (
        f"An offset of 10 % of the largest output, as the report has it, is {0.1 * full_mv:.0f} mV at the bridge of F_z and would be "
        f"{1e-4 * full_mv * readout.gains[0]:.0f} V after the amplifier: it must be trimmed at the bridge, as Fig. 6.6 does. What the "
        "trimmer "
        f"leaves may drift by {1e3 * readout.adc_limit / readout.gains[0]:.0f} mV at most before the converter saturates.",
        f"A converter of {readout.adc_limit:g} V and the printed sensitivity and gain read at most {end_mn:.0f} mN, and 17 mN with the "
        "papers' "
        "gain of 3000. The fingertip bears 3 N and 60 N in the tests while the readings stay on scale: either less than 1 % of the force "
        "passes through the chip, or the sensitivity of Table 6.1 is not that of the chip inside its rubber.",
    )
    return Section("Offset, gain and filter (Figs 6.6 and 6.10)", (*text, *section.paragraphs), section.tables, section.figures)


def _specification(analysis: ChipAnalysis) -> Section:
    design = analysis.design
    _, (strength, sensitivity) = printed_table("6.1")
    force, moment = float(strength[1]), float(strength[2])
    s_f, s_m = float(sensitivity[1]), float(sensitivity[2])
    coefficient = design.piezoresistance.longitudinal(design.beam_direction)
    needed = [1e-6 * 2.0 * 1e-3 * s * load / (design.supply_voltage * coefficient) for s, load in ((s_f, force), (s_m, moment))]
    at = [1e-6 * float(largest_stress(design, *loads)) for loads in ((force, 0, 0), (0, 0, moment), (force, 0, moment))]
    limits = load_limits(design)
    surface = [
        tuple(1e-6 * float(v) for v in surface_stress(analysis.whole, (0.0, 0.0, f, 0.0, m, 0.0)))
        for f, m in ((force, 0.0), (0.0, moment), (force, moment))
    ]
    strength_table = Table(
        "Table 6.1, strength",
        (
            "load",
            "paper",
            "largest nominal stress, GPa",
            "stress at the resistors, GPa",
            "upper surface, finite elements, GPa",
            "lower surface, finite elements, GPa",
            "borne at the assumed strength",
        ),
        (
            ("F_z, mN", force, at[0], needed[0], *surface[0], float(limits[0])),
            ("M_x or M_y, N µm", moment, at[1], needed[1], *surface[1], float(limits[1])),
            ("both together", None, at[2], None, *surface[2], None),
        ),
        note="The stress at the resistors follows from the printed sensitivity, the supply and the piezoresistance alone, whatever the "
        "dimensions: V = π σ V_in / 2. It is a lower bound of the largest stress. Finite elements: largest tension on the beams up to "
        "a quarter of the thickness from their ends, where it is below the nominal stress; nearer to the sharp corners it rises without "
        "bound, so that they must be rounded. Either limit is nominally borne by good etched silicon, both together are not trusted: "
        f"{at[2]:.2g} GPa. A combined load must stay below the line F_z / {limits[0]:.0f} mN + M / {limits[1]:.0f} N µm = 1.",
    )
    figure = Figure(
        "Safe loads",
        "Largest force and moment together; the cross is the corner of the printed limits.",
        lambda canvas: chip_figures.envelope(canvas, design, [(force, moment)], marked="5000 mN and 800 N µm"),
        (7.0, 4.2),
    )
    ends = tuple(filleted_end(design, radius) for radius in FILLETS_MM)
    rounded = ends[1].load_limits(analysis.beams)
    text = (
        "With the assumed dimensions the closed forms give the printed sensitivities; finite elements of the same chip keep that to F_z, "
        "whose "
        "resistors lie away from the ends, and lower those to moments, whose resistors lie where frame and block yield.",
        f"Rounded corners bound the stress: with fillets of {1e3 * ends[1].fillet_mm:g} µm the beams bear {rounded[0]:.0f} mN "
        f"or {rounded[1]:.0f} N µm at the assumed strength. The printed limits need stronger silicon, or larger fillets.",
        "By the symmetry of the chip no bridge reads the load of another. Lateral forces, which it does not measure, tilt the block on its "
        "elastic frame and enter the moments by 1.5 % of full scale. A mask that is off by 2 µm adds twist and lateral force by less.",
    )
    fillets, borne = fillet_table(analysis, ends), fillet_figure(analysis, ends, [(force, moment)], marked="5000 mN and 800 N µm")
    cross = crosstalk_tables(analysis, (5e3, 5e3, 5e3, 8e2, 8e2, 8e2))
    tables = (sensitivity_table(analysis, (s_f, s_m, s_m)), strength_table, fillets, *cross)
    return Section("Specification (Table 6.1)", text, tables, (placement_figure(analysis), figure, borne))
