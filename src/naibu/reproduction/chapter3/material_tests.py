"""Material tests, Tables 3.4 and 3.5 of the 2008 report :cite:p:`hirai2008`: moduli of the gels from compression and from CT images.

The report prints no readings of its tests, only their results. Reproduced is what follows from these: the means and their uncertainty, the
effects that could make the specimens of one gel differ :cite:p:`gent1959`, and, for Poisson's ratio, the markers inside the same gels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from naibu import datasets
from naibu.core.arrays import FloatArray, IntArray
from naibu.identification.material_testing.uniaxial import Specimen, poisson_ratio, specimen_mean
from naibu.reproduction.chapter3.poisson_readings import (
    GELS,
    PIXEL_MM,
    PLATE_STATES,
    READING_SD,
    SIDE_MM,
    constrained_block,
    marker_ratios,
    matching_pairs,
    readings,
)
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

VOLUME_SPREAD = 0.03  # range of the markers' volume ratios about 1
Spread = Callable[[FloatArray, "Specimens", float], FloatArray]  # moduli of the specimens' gels, specimens, parameter -> apparent moduli
USUAL_STRAIN = 0.1  # at which compression tests of gels are evaluated; the report does not state it


@dataclass(frozen=True, slots=True, eq=False)
class Specimens:
    """Cylinders of Table 3.4: gel (number), shape factor, area over height (mm), height (mm), printed modulus (kPa); (6,) each."""

    gel: IntArray
    shape_factor: FloatArray
    area_over_height: FloatArray
    height: FloatArray
    printed: FloatArray


CHANCE, CONSTRAINED, COMPLIANCE, SLACK = (
    "chance alone",
    "faces bonded to the plates, 1 + 2 S^2 (Gent and Lindley 1959)",
    "compliance of the machine, mm/mN",
    "slack counted as strain, mm at a strain of 10 %",
)
_SPREAD: dict[str, tuple[Spread, bool]] = {
    CHANCE: (lambda e, s, p: e, False),
    CONSTRAINED: (lambda e, s, p: e * (1.0 + 2.0 * s.shape_factor**2), False),
    COMPLIANCE: (lambda e, s, p: e / (1.0 + e * p * s.area_over_height), True),
    SLACK: (lambda e, s, p: e / (1.0 + p / (USUAL_STRAIN * s.height)), True),
}


def table_3_4() -> Section:
    """Return Table 3.4: Young's moduli of the gels from compression tests, printed and ours, and effects that could spread them."""
    _, rows = printed_table("3.4")
    cells: list[tuple[Cell, ...]] = []
    for gel in dict.fromkeys(r[0] for r in rows):
        own = [r for r in rows if r[0] == gel]
        mean = specimen_mean([r[3] * 1e-3 for r in own])
        for row in own:
            specimen = Specimen.cylinder(row[1], row[2])
            corrected = row[3] * 1e-3 / specimen.bonded_stiffening
            cells.append((gel, row[1], row[2], row[3] * 1e-3, round(specimen.shape_factor, 3), round(corrected, 1), None, None, None, None))
        constrained = specimen_mean([r[3] * 1e-3 / Specimen.cylinder(r[1], r[2]).bonded_stiffening for r in own])
        low, high = mean.interval
        cells.append(
            (gel, None, None, None, None, round(constrained.mean, 1), own[0][4] * 1e-3, round(mean.mean, 1), round(mean.standard_error, 1),
             f"{low:.0f} to {high:.0f}")
        )  # fmt: skip
    columns = (
        "gel", "diameter (mm)", "height (mm)", "E, paper (kPa)", "shape factor S", "E for bonded faces, ours (kPa)",
        "mean, paper (kPa)", "mean, ours (kPa)", "standard error (kPa)", "95 % interval (kPa)",
    )  # fmt: skip
    note = (
        "Means are those of the three specimens. Interval: Student's t with 2 degrees of freedom. The corrected column divides by "
        "1 + 2 S^2, as if the faces had been bonded to the plates."
    )
    tables = (
        Table(
            "Table 3.4",
            columns,
            tuple(cells),
            caption="Young's modulus of the gels from compression tests of three cylinders each.",
            note=note,
        ),
        _spread_table(rows),
    )
    return Section("Table 3.4: Young's modulus from compression tests", _spread_text(tables[1]), tables)


def _specimens(rows: list[list[Any]]) -> Specimens:
    gels = list(dict.fromkeys(r[0] for r in rows))
    made = [Specimen.cylinder(r[1], r[2]) for r in rows]
    return Specimens(
        np.array([gels.index(r[0]) for r in rows]), np.array([m.shape_factor for m in made]), np.array([m.area / m.height for m in made]),
        np.array([m.height for m in made], dtype=float), np.array([r[3] for r in rows]) * 1e-3,
    )  # fmt: skip


def explained_spread(specimens: Specimens, effect: str) -> tuple[tuple[float, float], float | None, float]:
    """Fit two moduli and the parameter of an effect, if it has one, to the printed moduli, by least squares of the logarithms.

    Returns
    -------
    moduli : (float, float)
        Young's moduli of both gels, kPa.
    parameter : float or None
        Parameter of the effect.
    residual_sd : float
        Relative standard deviation of the residuals, per degree of freedom.
    """
    model, has_parameter = _SPREAD[effect]

    def residual(x: FloatArray) -> FloatArray:
        parameter = float(np.exp(x[2])) if has_parameter else 0.0
        return np.asarray(np.log(model(np.exp(x[:2])[specimens.gel], specimens, parameter) / specimens.printed))

    starts = [-12.0, -8.0, -4.0, 0.0] if has_parameter else [0.0]
    fits = [least_squares(residual, np.r_[np.log([200.0, 100.0]), start][: 2 + has_parameter]) for start in starts]
    best = min(fits, key=lambda fit: float(fit.cost))
    residual_sd = float(np.sqrt(2.0 * best.cost / (len(specimens.gel) - 2 - has_parameter)))
    moduli = float(np.exp(best.x[0])), float(np.exp(best.x[1]))
    return moduli, float(np.exp(best.x[2])) if has_parameter else None, residual_sd


def _spread_table(rows: list[list[Any]]) -> Table:
    """Return how well one common effect explains the six moduli: two moduli, and at most one more parameter, for six values."""
    cells: list[tuple[Cell, ...]] = []
    for effect in _SPREAD:
        moduli, parameter, residual_sd = explained_spread(_specimens(rows), effect)
        shown = None if parameter is None else float(f"{parameter:.2g}")
        cells.append((effect, *(round(e, 0) for e in moduli), shown, round(100.0 * residual_sd, 1)))
    columns = (
        "effect",
        *(f"E of {g} (kPa)" for g in dict.fromkeys(r[0] for r in rows)),
        "its size",
        "residual SD (%)",
    )
    note = "Least squares of ln E, residual SD per degree of freedom. Six values only show which effects have the right sign."
    return Table("Spread of Table 3.4", columns, tuple(cells), caption="Effects that could make specimens of one gel differ.", note=note)


def _spread_text(table: Table) -> tuple[str, ...]:
    by_name = {str(row[0]): row for row in table.rows}
    left = {name: float(str(row[-1])) for name, row in by_name.items()}
    slack, compliance = by_name[SLACK][-2], float(str(by_name[COMPLIANCE][-2]))
    return (
        "The report gives neither the readings nor the range of strain nor the friction at the plates. Within each gel the lowest "
        "specimen has the lowest modulus. Bonded faces would have the opposite effect - they make low specimens appear stiffer - and the "
        f"correction for them changes the residual SD from {left[CHANCE]:.0f} to {left[CONSTRAINED]:.0f} %. Slack or machine compliance "
        f"counted as strain has the right sign and leaves {left[SLACK]:.0f} and {left[COMPLIANCE]:.0f} %, but it would take {slack} mm of "
        f"slack or {1e3 * compliance:.2g} mm/N of compliance, and moduli far above the printed ones. Specimens cast at different times may "
        "also differ. The readings would decide: naibu.identification.material_testing.uniaxial.compression_test estimates the slack "
        "from them.",
    )


def table_3_5(*, divisions: int = 6) -> Section:
    """Return Table 3.5: Poisson's ratios, printed and ours, and quantified explanations of their difference.

    Parameters
    ----------
    divisions : int
        Cells per edge of the simulated block with constrained faces.
    """
    _, rows = printed_table("3.5")
    printed = {row[0]: (-float(row[1]), float(row[2]), float(row[3])) for row in rows}
    tables = (_ratio_table(printed), _definition_table(printed), _candidate_table(printed, divisions), _volume_table(printed, divisions))
    caption = "Lateral strain of every marker layer under a plate, and the values printed in the report."
    figures = (Figure("Lateral strain of the marker layers", caption, _draw_lateral_strain),)
    return Section("Table 3.5: Poisson's ratio from CT images", _ratio_text(printed, tables), tables, figures)


def _ratio_table(printed: dict[str, tuple[float, float, float]]) -> Table:
    cells: list[tuple[Cell, ...]] = []
    for gel, (along, across, value) in printed.items():
        given = [poisson_ratio(along, across, definition=d).value for d in ("engineering", "hencky")]
        found = poisson_ratio(along, across)
        cells.append(
            (gel, "report, Table 3.5", -along, across, value, *(round(v, 3) for v in given), None, round(found.volume_ratio, 3), None)
        )
    for source in marker_ratios():
        r, along, across = source.ratio, source.longitudinal, source.transversal
        small = poisson_ratio(along, across, definition="engineering").value
        cells.append(
            (source.gel, f"markers, {source.label}", round(-along, 3), round(across, 3), None, round(small, 3), round(r.value, 3),
             round(r.standard_error, 3), round(r.volume_ratio, 3), round(r.volume_ratio_standard_error, 3))
        )  # fmt: skip
    columns = (
        "gel", "source", "axial strain", "lateral strain", "nu, paper", "nu, ratio of strains", "nu, Hencky", "standard error",
        "volume ratio J", "standard error of J",
    )  # fmt: skip
    note = (
        "Compression is positive, as in the report. 0.10 / 0.32 is 0.31; 0.33 is printed. Markers: local affine maps, SD of a coordinate "
        "0.15 mm. nu (Hencky) = (1 - ln J / ln l) / 2; the gel of the plate cube is not stated."
    )
    return Table("Table 3.5", columns, tuple(cells), caption="Poisson's ratio of the gels.", note=note)


_STRETCH: dict[str, Callable[[float], float]] = {
    "over the free length": lambda e: 1.0 + e,
    "logarithmic (Hencky)": lambda e: float(np.exp(e)),
    "Green-Lagrange": lambda e: float(np.sqrt(1.0 + 2.0 * e)),
    "over the deformed length": lambda e: 1.0 / (1.0 - e),
    "Euler-Almansi": lambda e: float(1.0 / np.sqrt(1.0 - 2.0 * e)),
}


def _definition_table(printed: dict[str, tuple[float, float, float]]) -> Table:
    cells: list[tuple[Cell, ...]] = []
    for name, stretch in _STRETCH.items():
        volumes = [stretch(along) * stretch(across) ** 2 for along, across, _ in printed.values()]
        cells.append((name, *(round(v, 3) for v in volumes)))
    columns = ("strain, if it was defined as", *(f"J of {gel}" for gel in printed))
    note = f"A definition would explain the table if both volume ratios were those of the markers, 1.00 within {VOLUME_SPREAD:g}."
    return Table("Strain measures", columns, tuple(cells), caption="Volume ratios that the printed strains imply.", note=note)


def _candidate_table(printed: dict[str, tuple[float, float, float]], divisions: int) -> Table:
    cells: list[tuple[Cell, ...]] = []
    for name, pairs in _candidates(printed, divisions).items():
        row: list[Cell] = [name]
        distances = []
        for gel in GELS:
            along, across = pairs[gel]
            distances.append(float(np.hypot(along - printed[gel][0], across - printed[gel][1])) / READING_SD)
            row += [round(-along, 3), round(across, 3), round(-across / along, 2)]
        cells.append((*row, *(round(d, 1) for d in distances)))
    columns = (
        "reading", *(f"{what}, {gel}" for gel in GELS for what in ("axial", "lateral", "nu")),
        *(f"distance from printed, {gel} (SD)" for gel in GELS),
    )  # fmt: skip
    note = f"Markers of ct_two_material_2, the experiment of chapter 3.6. One standard deviation of a reading is taken as {READING_SD:g}."
    return Table(
        "Candidate readings",
        columns,
        tuple(cells),
        caption="Strains that could have been read from the images, and the printed ones.",
        note=note,
    )


def _candidates(printed: dict[str, tuple[float, float, float]], divisions: int) -> dict[str, dict[str, tuple[float, float]]]:
    """Return axial and lateral strain of both gels for every candidate reading."""
    seen = readings("ct_two_material_2", "deformed")
    lateral = {gel: {k: v for k, v in seen.transversal.items() if gel in k} for gel in GELS}
    own = {gel: float(np.mean(list(lateral[gel].values()))) for gel in GELS}
    least = {gel: min(lateral[gel].values()) for gel in GELS}
    along = {gel: next(v for k, v in seen.longitudinal.items() if gel in k) for gel in GELS}
    stack, stated = seen.longitudinal["all layers"], seen.longitudinal["stated height"]
    constrained = {gel: constrained_block(-printed[gel][0], 0.49, divisions) for gel in GELS}
    free = {gel: float((1.0 + printed[gel][0]) ** -0.5) - 1.0 for gel in GELS}
    out = {
        "the gel's own layers": {g: (along[g], own[g]) for g in GELS},
        "axial strain of the whole stack, lateral strain of the gel": {g: (stack, own[g]) for g in GELS},
        "axial strain of the whole stack, lateral strain of the gel's outermost layer": {g: (stack, least[g]) for g in GELS},
        "axial strain from the stated height, lateral strain of the gel": {g: (stated, own[g]) for g in GELS},
        "incompressible, free sides": {g: (printed[g][0], free[g]) for g in GELS},
        "incompressible, one side of two read": {g: (printed[g][0], 0.5 * free[g]) for g in GELS},
    }
    for name, height in (("middle", 0.5), ("one sixth of the height above a face", 1 / 6), ("one twelfth above a face", 1 / 12)):
        key = f"simulated block, nu 0.49, constrained faces, {name}"
        out[key] = {g: (printed[g][0], constrained[g].transversal_at(height)) for g in GELS}
    return out


def _volume_table(printed: dict[str, tuple[float, float, float]], divisions: int) -> Table:
    cells: list[tuple[Cell, ...]] = []
    for gel, (along, _, value) in printed.items():
        for nu, whose in ((value, "printed"), (0.49, "0.49")):
            block = constrained_block(-along, nu, divisions)
            cells.append((gel, whose, nu, -along, round(block.volume_ratio, 3), round(block.transversal_at(0.5), 3)))
    columns = ("gel", "source of nu", "nu", "axial strain", "volume ratio of the block", "lateral strain in the middle")
    note = "Cube with constrained faces, neo-Hookean, hexahedra with mean dilatation."
    return Table(
        "Volume under the printed ratio", columns, tuple(cells), caption="Marker strains for the printed Poisson ratio.", note=note
    )


def _ratio_text(printed: dict[str, tuple[float, float, float]], tables: Sequence[Table]) -> tuple[str, ...]:
    volumes = [source.ratio.volume_ratio for source in marker_ratios()]
    lost = [1.0 - (1.0 + a) * (1.0 + t) ** 2 for a, t, _ in printed.values()]
    pixels = [((1.0 + a) ** -0.5 - 1.0 - t) * SIDE_MM / PIXEL_MM for a, t, _ in printed.values()]
    counts = matching_pairs(list(printed.values()))
    distances = {str(row[0]): tuple(float(str(d)) for d in row[-len(GELS) :]) for row in tables[2].rows}
    nearest = min(distances, key=lambda name: max(distances[name]))
    kept = [str(row[0]) for row in tables[1].rows if all(abs(float(str(v)) - 1.0) <= VOLUME_SPREAD for v in row[1:])]
    constrained = [float(str(row[4])) for row in tables[3].rows if row[1] != "printed"]
    measure = f"read as {' or '.join(kept)}, both printed pairs are isochoric" if kept else "under none are both printed pairs isochoric"
    return (
        f"The printed strains imply that the gels lost {100 * lost[0]:.0f} and {100 * lost[1]:.0f} % of their volume. The markers inside "
        f"the same gels, in the same kind of images, give {min(volumes):.2f} to {max(volumes):.2f} times the undeformed volume.",
        f"Resolution: for an incompressible gel, the width of the {SIDE_MM:.0f} mm cube would have been misread by {pixels[0]:.0f} and "
        f"{pixels[1]:.0f} pixels. Strain measure: {measure}. Constrained faces: they reduce the lateral strain near plate and table only, "
        f"and at nu = 0.49 leave {min(constrained):.2f} to {max(constrained):.2f} of the volume (last table).",
        f"Other readings: of all {counts.tried} pairs of an axial and a lateral strain between marker layers of the bundled "
        f"plate experiments, {counts.fitting[0]} lie within two standard deviations of the printed pair of {GELS[0]} and "
        f"{counts.fitting[1]} of that of {GELS[1]}. Of the candidates in the third table the one nearest to both is '{nearest}': "
        f"{distances[nearest][0]:g} and {distances[nearest][1]:g} standard deviations away.",
        "The printed ratios are therefore not a property of the gels. How the strains were read is not recorded, and closeness does not "
        "prove any of these candidates; a ratio of two strains is Poisson's ratio only at small strain and with free sides, whereas the "
        "volume change between markers needs neither.",
    )


def _draw_lateral_strain(canvas: Canvas) -> None:
    """Draw the lateral strain of the marker layers over their height, and the printed values."""
    axes = canvas.add_subplot()
    _, rows = printed_table("3.5")
    for (name, state), marker in zip(PLATE_STATES, "os^v", strict=True):
        seen = readings(name, state)
        axes.plot(list(seen.transversal.values()), datasets.load(name).nominal_heights_mm, marker + "-", label=f"{name}, {state}")
    for row, style in zip(rows, (":", "--"), strict=True):
        axes.axvline(row[2], color="0.3", linestyle=style, label=f"Table 3.5, {row[0]}")
    axes.set(xlabel="lateral strain", ylabel="height of the marker layer above the base (mm)", xlim=(0.0, None))
    axes.legend(fontsize=8)
