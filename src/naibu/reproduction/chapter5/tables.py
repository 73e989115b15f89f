"""Chapter 5 of the 2008 report :cite:p:`hirai2008`: active ischemia, and mammography."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.applications.ischemia.layer_identification import LayerEstimate
from naibu.mechanics.small_strain.rheology import Rheology
from naibu.reproduction.chapter5 import figures, ischemia
from naibu.reproduction.chapter5.ischemia import DURATION_S, JET_RADIUS_MM, LOWER, SAME, THRESHOLD_KPA, UPPER, Response
from naibu.reproduction.chapter5.mammography import phantom_section, scans_section
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

FREQUENCIES_HZ = np.geomspace(0.1, 100.0, 25)
NOISE_MM = 0.02
UNITS = {"young_modulus": ("E", "kPa"), "voigt_viscosity": ("C1", "kPa s"), "series_viscosity": ("C2", "kPa s")}
TIMES_OF = (
    "rise 10-90 %, s",
    "fall 10-90 %, s",
    "rise, time constant, s",
    "fall, time constant, s",
    "at release, mm",
    "residual at 3 s, mm",
)


def chapter5(seed: int = 0) -> Chapter:
    """Reproduce chapter 5.

    Parameters
    ----------
    seed : int
        Of the noise of the identified records.
    """
    plane = ischemia.modes_of("plane_strain", JET_RADIUS_MM)
    same = [ischemia.response(name, plane, m, m, JET_RADIUS_MM) for name, m in SAME.items()]
    layered = [ischemia.response(name, plane, m, UPPER, JET_RADIUS_MM) for name, m in LOWER.items()]
    same_grid = [ischemia.printed_grid(name, m, m) for name, m in SAME.items()]
    layered_grid = [ischemia.printed_grid(name, m, UPPER) for name, m in LOWER.items()]
    sections = (
        _model(),
        _same(same, same_grid),
        _layers(layered, layered_grid),
        _time_constants(),
        _pale_area(),
        _frequencies(),
        _identification(seed),
        phantom_section(),
        scans_section(),
    )
    settings: dict[str, Cell] = {"seed": seed, **ischemia.ASSUMED}
    return Chapter("ch5", "Chapter 5: active ischemia of skin, and mammography", sections, settings)


def _row(response: Response) -> tuple[Cell, ...]:
    m = response.measured
    return m.rise_s, m.fall_s, m.rise_constant_s, m.fall_constant_s, m.peak, m.residual


def _model() -> Section:
    material = SAME["C1 = 30 Pa s"]
    cases = {
        "printed grid, bricks with averaged dilatation": (ischemia.printed_grid_modes(), 0.0),
        "20 × 14 cells over a half, plane strain": (ischemia.modes_of("plane_strain", JET_RADIUS_MM), JET_RADIUS_MM),
        "10 × 8 cells over a half, plane strain": (ischemia.modes_of("plane_strain", JET_RADIUS_MM, across=10, upwards=8), JET_RADIUS_MM),
        "20 × 14 cells, axisymmetric": (ischemia.modes_of("axisymmetric", JET_RADIUS_MM), JET_RADIUS_MM),
        "three-dimensional": (ischemia.modes_of("three_dimensional", JET_RADIUS_MM, across=5, upwards=6), JET_RADIUS_MM),
    }
    rows: list[tuple[Cell, ...]] = [("printed grid, triangles, with inertia", *_row(ischemia.printed_grid("", material, material)))]
    rows += [(name, *_row(ischemia.response("", modes, material, material, radius))) for name, (modes, radius) in cases.items()]
    triangles, bricks, converged = (float(str(rows[i][5])) for i in (0, 1, 2))
    table = Table(
        "Models", ("model", *TIMES_OF), tuple(rows),
        caption=f"Skin of one material, C1 = 30 Pa s; {ischemia.FORCE_MN:g} mN for {DURATION_S:g} s.",
        note=f"Triangles with one strain each lock at a Poisson ratio of {ischemia.POISSON_RATIO:g}: on the printed grid they "
        f"are too stiff by a factor "
        f"of {converged / triangles:.1f} against the converged mesh although their force acts on a point, where bricks that do "
        f"not lock give {bricks:.1f} mm. "
        "Time constants do not depend on the mesh. All indentations exceed the height of the skin, 1 mm: with the printed force "
        "and modulus the "
        "strains are not small, and the linear model, which the report uses, does not hold in amplitude; its time constants are "
        "those of small forces.",
    )  # fmt: skip
    paragraphs = (
        "Layers of three-element material on a fixed base, loaded by a force in the middle of the surface, and released. "
        "Without inertia the "
        "response of two layers is known in closed form in the eigenvectors of their stiffnesses; bricks with averaged "
        "dilatation do not lock. "
        f"The mass of the patch is {1e6 * ischemia.patch_mass_kg():.1f} mg: inertia changes nothing that can be seen.",
        "The report compares with measurements of a fingertip that are printed as curves only and are not reproduced here.",
    )
    return Section("Model of the skin", paragraphs, (table,))


def _same(fine: Sequence[Response], coarse: Sequence[Response]) -> Section:
    rows = tuple((r.name, mesh, *_row(r)) for mesh, found in (("converged", fine), ("printed", coarse)) for r in found)
    table = Table("Figure 5.8, numbers", ("layers", "mesh", *TIMES_OF), rows, caption="Both layers alike.")
    figure = Figure("Fig. 5.8", "Indentation over time, both layers alike.", figures.indentations(fine, coarse), (10.0, 3.8))
    text = (
        "As the report says, the residual displacement depends on the dashpot in series only, and rise and fall are faster with "
        "C1 = 30 than with "
        "80 Pa s.",
    )
    return Section("One material (Figure 5.8)", text, (table,), (figure,))


def _layers(fine: Sequence[Response], coarse: Sequence[Response]) -> Section:
    rows = tuple((r.name, mesh, *_row(r)) for mesh, found in (("converged", fine), ("printed", coarse)) for r in found)
    table = Table(
        "Figure 5.9, numbers",
        ("layers", "mesh", *TIMES_OF),
        rows,
        caption="Soft lower layer: E 0.5 kPa; upper layer: E 3.8 kPa, C1 30 Pa s.",
    )
    figure = Figure("Fig. 5.9", "Indentation over time, soft lower layer.", figures.indentations(fine, coarse), (10.0, 3.8))
    text = (
        "The soft layer gives the curved rise between 0.1 and 0.5 s which the report looked for: after the fast rise of the "
        "upper layer comes the slow "
        "one of the lower layer.",
    )
    return Section("Two layers (Figure 5.9)", text, (table,), (figure,))


def _time_constants() -> Section:
    modes = ischemia.modes_of("plane_strain", JET_RADIUS_MM, across=10, upwards=8)
    rows = tuple(
        (what, value, r.measured.rise_s, r.measured.fall_s, r.measured.rise_constant_s, r.measured.fall_constant_s)
        for what, value, r in ischemia.parameter_study(modes)
    )
    table = Table(
        "What the time constants depend on", ("changed", "value", *TIMES_OF[:4]), rows,
        caption="Skin of one material; otherwise E = 3.8 kPa, C1 = 30 Pa s, C2 = 30 kPa s, 0.47 s.",
        note=f"In skin of one material both time constants are C1/E exactly: {1e3 * UPPER.retardation_time:.1f} ms for 3.8 kPa "
        f"and 30 Pa s.",
    )  # fmt: skip
    text = (
        "The report concludes (5.5) that the time constants do not depend on viscoelasticity but on how long the force acts. "
        "This contradicts its own "
        "Figure 5.8, and is not so: the time constants are proportional to C1 and to 1/E, and do not depend on the duration. "
        "What depends on "
        "the duration is the time from 10 to 90 % of the rise, because the flow of the dashpot in series goes on as long as the "
        "force acts.",
    )
    return Section("Time constants and viscoelasticity", text, (table,))


def _pale_area() -> Section:
    modes = ischemia.modes_of("axisymmetric", JET_RADIUS_MM, across=40, upwards=14)
    found = [
        ischemia.response("C1 = 30 Pa s", modes, UPPER, UPPER, JET_RADIUS_MM),
        ischemia.response("lower C1 = 1000 Pa s", modes, LOWER["model 2, lower C1 = 1000 Pa s"], UPPER, JET_RADIUS_MM),
    ]
    rows: list[tuple[Cell, ...]] = []
    for response in found:
        if response.motion is not None:
            for threshold in (0.5 * THRESHOLD_KPA, THRESHOLD_KPA, 2.0 * THRESHOLD_KPA):
                area = response.motion.pale_area(threshold)
                at = [float(area[int(np.argmin(np.abs(response.times - t)))]) for t in (0.001, 0.05, 0.46, 0.475, 0.55)]
                rows.append((response.name, threshold, *at))
    table = Table(
        "Pale area", ("lower layer", "threshold, kPa", *(f"at {t:g} s, mm²" for t in (0.001, 0.05, 0.46, 0.475, 0.55))), tuple(rows),
        caption="Area in which the pressure in the tissue exceeds that of capillaries; round jet of 0.79 mm², axisymmetric.",
        note="A pressure follows the load at once where the layers relax alike; where they do not, it is redistributed at the "
        "rates of the layers. What "
        "is slow in a pale area that is seen is then either this, or the blood that returns, which is not modelled.",
    )  # fmt: skip
    figure = Figure("Pale area", "Area over time, and pressure along the radius.", figures.pale_areas(found), (10.0, 3.8))
    return Section("Pale area", (), (table,), (figure,))


def _frequencies() -> Section:
    modes = ischemia.modes_of("plane_strain", JET_RADIUS_MM, across=10, upwards=8)
    materials: dict[str, tuple[Rheology, Rheology]] = {name: (m, m) for name, m in SAME.items()}
    materials |= {name: (m, UPPER) for name, m in LOWER.items() if "1000" in name}
    found = {name: ischemia.bode(modes, *pair, FREQUENCIES_HZ) for name, pair in materials.items()}
    from_time = {float(f): ischemia.frequency_from_time(modes, UPPER, float(f)) for f in (0.1, 1.0, 10.0, 100.0)}
    direct = ischemia.bode(modes, UPPER, UPPER, np.array(list(from_time)))
    rows = tuple(
        (f, float(abs(d)), float(abs(t)), float(np.degrees(np.angle(d))), float(np.degrees(np.angle(t))))
        for (f, t), d in zip(from_time.items(), direct, strict=True)
    )
    columns = ("frequency, Hz", "amplitude, mm/mN", "from the time domain", "phase, degrees", "from the time domain")
    table = Table(
        "Frequency response",
        columns,
        rows,
        caption="C1 = 30 Pa s: direct with inertia, and the transform of the response to a pulse without.",
    )
    figure = Figure(
        "Frequency response", "Indentation for an oscillating force.", figures.bode_diagram(FREQUENCIES_HZ, found, from_time), (8.0, 5.0)
    )
    return Section(
        "Frequency response", ("The report names the frequency response as a measure and does not compute it.",), (table,), (figure,)
    )


def _identification(seed: int) -> Section:
    lower = LOWER["model 2, lower C1 = 1000 Pa s"]
    estimate = ischemia.identified(lower, NOISE_MM, seed)
    table = Table(
        "Identified layers", ("layer", "parameter", "true", "estimate", "95 % from", "to", "determined"),
        _identified_rows(estimate, (lower, UPPER)),
        caption=f"From the indentation over 3 s of a finer mesh, with {NOISE_MM:g} mm of noise.",
        note="Not determined: the interval spans more than a factor of 4. The flow of the lower layer and its spring are hard "
        "to tell apart from one press.",
    )  # fmt: skip
    return Section("Identification of the layers", (), (table,))


def _identified_rows(estimate: LayerEstimate, truth: tuple[Rheology, ...]) -> tuple[tuple[Cell, ...], ...]:
    rows: list[tuple[Cell, ...]] = []
    for p in estimate.parameters:
        symbol, unit = UNITS[p.name]
        rows.append(
            ("upper" if p.layer else "lower", f"{symbol}, {unit}", float(getattr(truth[p.layer], p.name)), p.value, p.low, p.high,
             "yes" if p.determined else "no")
        )  # fmt: skip
    return tuple(rows)
