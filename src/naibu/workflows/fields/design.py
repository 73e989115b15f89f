"""Plan an experiment: how well moduli will be known, by push, number of points and noise, as a table, numbers and a page."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import product
from pathlib import Path

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray, IntArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.experiment import Layer
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_fields.identified.sides import SIDES
from naibu.identification.from_fields.planning.planned_identification import planned_identification
from naibu.identification.verdict import UNDETERMINED
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.viewer.json_values import jsonable
from naibu.viewer.page_frame import page_html
from naibu.viewer.tables import Cell, Table, table_html
from naibu.workflows.fields.block_mesh import CELLS, block_mesh, labelled_object, names_of_labels, sizes_of_voxels
from naibu.workflows.fields.known_zones import parse_known_zones, stated_moduli
from naibu.workflows.fields.predict_field import parsed_sides
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

FILES = ("design.html", "design.json")
VOXELS = 48  # along the longest side of a box
LEAST_POINTS, MOST_POINTS = 30, 200_000
MOST_PLANS = 60
ALL = "all of them together"
COLUMNS = (
    "push", "points", "noise, mm", "zone", "Young's modulus, kPa", "SD, %", "SD from noise, %", "95 % from, kPa", "to, kPa",
    "systematic error, %", "Poisson's ratio", "SD of Poisson's ratio",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Planned:
    """How well one zone will be known.

    Attributes
    ----------
    push : str
        The loading.
    points : int
        Points, or markers, whose displacement is measured.
    noise_mm : float
        Standard deviation of a component of it, mm.
    zone : str
        The zone.
    young_modulus, poisson_ratio : float
        Expected Young's modulus, kPa, and Poisson's ratio.
    young_modulus_sd : float
        Relative standard deviation of Young's modulus: noise, elements, and what is not known of known zones.
    noise_sd : float
        The part of the noise in that of the shear modulus.
    interval : (float, float)
        Bounds that will hold Young's modulus with a probability of 95 %, kPa, if it is as expected.
    bias : float
        Relative systematic error of Young's modulus without noise.
    poisson_ratio_sd : float
        Standard deviation of Poisson's ratio.
    """

    push: str
    points: int
    noise_mm: float
    zone: str
    young_modulus: float
    young_modulus_sd: float
    noise_sd: float
    interval: tuple[float, float]
    bias: float
    poisson_ratio: float
    poisson_ratio_sd: float

    @property
    def error(self) -> float:
        """Root mean square of the relative error of Young's modulus to be expected, systematic and random."""
        return math.hypot(self.young_modulus_sd, self.bias)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """What `design` returns.

    Attributes
    ----------
    rows : tuple of Planned
        Every push, number of points, noise and zone.
    notes : tuple of str
        What is best, and what it rests on, in words.
    files : tuple of Path
        What was written.
    """

    rows: tuple[Planned, ...]
    notes: tuple[str, ...]
    files: tuple[Path, ...] = ()

    def table(self) -> Table:
        """Return the rows as a table."""
        return Table("Expected accuracy", COLUMNS, tuple(_cells(row) for row in self.rows), note="SD: standard deviation.")


@no_empty_folders()
def design(
    zones: str | os.PathLike[str] | None = None,
    *,
    size_mm: tuple[float, float, float] | None = None,
    layers: Sequence[Layer] = (),
    zone_names: Mapping[int, str] | None = None,
    known: Sequence[str],
    expected: Sequence[str],
    pushes: Sequence[str],
    points: Sequence[int] = (400,),
    noise_mm: Sequence[float] = (0.1,),
    plates_only: bool = False,
    law: LawName = "neo_hookean",
    element_size_mm: float = 0.0,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Design:
    """Predict how well moduli will be known from a planned experiment, with displacement fields or with markers.

    Every push, number of points and noise is tried with each other; where there are several pushes, also all of them as load cases of one
    identification.

    Parameters
    ----------
    zones : path-like, optional
        Volume of labels of the object, one for each material, 0 outside; or else a box of `size_mm`.
    size_mm : (float, float, float), optional
        Sides of a box along x, y and z.
    layers : sequence of Layer
        Its materials, from the base up.
    zone_names : mapping, optional
        Names of labels.
    known : sequence of str
        Zones whose moduli will be known, as for `naibu.workflows.identify_fields`.
    expected : sequence of str
        What the moduli of the others may be: ``"gel=5 kPa, 0.45"``.
    pushes : sequence of str
        Sides that are moved, in mm: ``"z+=0,0,-3"``. The opposite side is held, both stick, and all other surface is free.
    points : sequence of int
        Numbers of measured points: of markers, or of independent vectors of a field, evenly over the body.
    noise_mm : sequence of float
        Standard deviations of a component of a measured displacement, mm.
    plates_only : bool
        Whether nothing but the two plates of a push touches the object, which the identification then knows (`loaded` of
        `naibu.workflows.identify_fields`); by default the whole surface may be loaded.
    law : {"neo_hookean", "linear"}
        Finite or small strain.
    element_size_mm : float
        Edge length of the cubes; 0 makes about 1200 of them.
    out : path-like, optional
        Folder for ``design.html`` and ``design.json``.
    overwrite : bool
        Whether these files may be there already.
    progress : callable, optional
        Gets a report after every plan.

    Raises
    ------
    InputError
        No object or two, zones without moduli, pushes of another form, or more than 60 plans.
    ConvergenceError
        A push is too large for an equilibrium, or the points do not determine how the surface moves.
    """
    _require_plans(points, noise_mm, pushes)
    if (zones is None) == (size_mm is None):
        raise InputError("give `zones`, a volume of labels, or `size_mm`, the sides of a box; one of them")
    folder = None if out is None else output_folder(out, FILES, overwrite=overwrite)
    if zones is None:
        assert size_mm is not None
        inside, labels, names = _box(size_mm, layers)
    else:
        if layers:
            raise InputError("`layers` go with `size_mm`, and zones come from a volume; leave them out")
        inside, labels = labelled_object(None, zones)
        names = names_of_labels(labels, inside, zone_names or {})
    stated = parse_known_zones(known, list(names.values()))
    sought = _expected(expected, [name for name in names.values() if name not in stated.values])
    longer = sizes_of_voxels(inside, element_size_mm) if element_size_mm else ()
    volume = float(inside.values.sum() * np.prod(inside.spacing_mm))
    mesh, _ = block_mesh(inside, labels, names, element_size_mm or (volume / CELLS) ** (1.0 / 3.0))
    model = stated.zones(mesh)
    young, poisson = np.array([sought[name] for name in model.names]).T
    truth = IdentifiedBody.stated(mesh, model, young, poisson, axes=inside.direction, law=law)
    loads = _loads(pushes, np.ptp(mesh.points, axis=0))
    plans = list(product(loads.items(), points, noise_mm))
    rows: list[Planned] = []
    for done, ((push, cases), count, noise) in enumerate(plans, start=1):
        found = planned_identification(truth, model, cases, points=count, noise_mm=noise, plates_only=plates_only)
        rows += _rows(found, truth, push, count, noise)
        report_progress(progress, f"{push}, {count} points, {noise:g} mm", done=done, total=len(plans))
    result = Design(tuple(rows), (*_notes(rows, plates_only), *longer))
    if folder is None:
        return result
    inputs = dict(input_record({"zones": zones}))
    return replace(result, files=tuple(_written(folder, result, {"known": list(known), "expected": list(expected), "inputs": inputs})))


def _rows(found: FieldEstimate, truth: IdentifiedBody, push: str, points: int, noise_mm: float) -> list[Planned]:
    """Return a row for every zone that is sought."""
    assert found.uncertainty is not None and found.budget is not None
    bounds, (of_young, of_poisson) = found.intervals()[0], found.uncertainty.of_young_and_poisson(found.theta)
    rows = []
    for i, (name, young, poisson) in enumerate(truth.moduli()[: len(truth.zones)]):
        of_noise, bias = float(found.budget.noise[i]), float(found.young_modulus[i] / young - 1.0)
        interval = float(bounds[i, 0]), float(bounds[i, 1])
        rows.append(
            Planned(push, points, noise_mm, name, young, float(of_young[i]), of_noise, interval, bias, poisson, float(of_poisson[i]))
        )
    return rows


def _require_plans(points: Sequence[int], noise_mm: Sequence[float], pushes: Sequence[str]) -> None:
    for count in points:
        if not LEAST_POINTS <= count <= MOST_POINTS:
            raise InputError(f"points must lie between {LEAST_POINTS} and {MOST_POINTS}, not {count}")
    for noise in noise_mm:
        require_lengths(noise_mm=noise)
    for name, given in (("`pushes`", pushes), ("points", points), ("noise_mm", noise_mm)):
        if not given:
            raise InputError(f"nothing is planned without {name}; give at least one" + ", such as 'z+=0,0,-3'" * (given is pushes))
    plans = len(points) * len(noise_mm) * (len(pushes) + (len(pushes) > 1))
    if plans > MOST_PLANS:
        raise InputError(f"`pushes`, points and noise_mm make {plans} plans; give fewer, for at most {MOST_PLANS} together")


def _box(size_mm: tuple[float, float, float], layers: Sequence[Layer]) -> tuple[Volume, IntArray, dict[int, str]]:
    """Return a box of layers as labels on a grid, its base at z = 0."""
    for side in size_mm:
        require_lengths(size_mm=side)
    if not layers:
        raise InputError("a box needs `layers`, its materials from the base up, one of them known")
    ordered = sorted(layers, key=lambda layer: layer.from_base_mm)
    edges = [0.0, *(layer.to_base_mm for layer in ordered)]
    for end, start in zip(edges, [*(layer.from_base_mm for layer in ordered), size_mm[2]], strict=True):
        if abs(end - start) > 1e-9:
            raise InputError(
                f"layers must fill the height of the box, 0 to {size_mm[2]:g} mm: from {min(start, end):g} to {max(start, end):g} mm there "
                + ("is none" if end < start else "is more than one, or it lies above the box")
            )
    thinnest = min(np.diff(edges))
    edge = min(max(size_mm) / VOXELS, thinnest / 2.0)
    counts = [max(2, round(side / edge)) for side in size_mm]
    spacing = np.array(size_mm) / counts
    heights = (np.arange(counts[2]) + 0.5) * spacing[2]
    names: dict[int, str] = {}
    for layer in ordered:
        names.setdefault(next((k for k, n in names.items() if n == layer.material), len(names) + 1), layer.material)
    number = {name: label for label, name in names.items()}
    of_height = np.array([number[layer.material] for layer in ordered])[np.searchsorted(edges[1:-1], heights)]
    labels = np.broadcast_to(of_height[:, None, None], (counts[2], counts[1], counts[0])).astype(np.int64)
    grid = Volume.from_array(np.ones(labels.shape, dtype=np.uint8), spacing_mm=spacing, origin_mm=0.5 * spacing)
    return grid, labels, names


def _expected(texts: Sequence[str], names: Sequence[str]) -> dict[str, tuple[float, float]]:
    out: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if name not in names:
            raise InputError(f"expected={text!r}: there is no unknown zone {name!r}; there are {', '.join(map(repr, names)) or 'none'}")
        out[name] = stated_moduli("expected", text, value)[0]
    if missing := [name for name in names if name not in out]:
        raise InputError(f"expected must say what the moduli of {missing[0]!r} may be, such as '{missing[0]}=5 kPa, 0.45'")
    if not out:
        raise InputError("every zone is known: there is nothing to plan")
    return out


def _loads(pushes: Sequence[str], extent_mm: FloatArray) -> dict[str, dict[str, dict[str, tuple[float, float, float]]]]:
    """Return load cases by plan: each push alone, and all of them together."""
    each: dict[str, dict[str, tuple[float, float, float]]] = {}
    for text in pushes:
        ((side, motion),) = parsed_sides((), [text], argument="pushes").items()
        if side not in SIDES:
            raise InputError(f"pushes={text!r}: side {side!r} is not known; use one of {', '.join(SIDES)}")
        axis, inwards = "xyz".index(side[0]), -1.0 if side[1] == "+" else 1.0
        if inwards * motion[axis] >= extent_mm[axis]:
            raise InputError(f"pushes={text!r}: the object is {extent_mm[axis]:.4g} mm long along {side[0]}; push less far")
        opposite = side[0] + ("-" if side[1] == "+" else "+")
        each[text] = {side: motion, opposite: (0.0, 0.0, 0.0)}
    plans = {text: {text: moved} for text, moved in each.items()}
    return plans | {ALL: each} if len(each) > 1 else plans


def _notes(rows: Sequence[Planned], plates_only: bool) -> tuple[str, ...]:
    worst: dict[tuple[str, int, float], Planned] = {}
    for row in rows:
        key = row.push, row.points, row.noise_mm
        if key not in worst or row.error > worst[key].error:
            worst[key] = row
    best = min(worst.values(), key=lambda row: row.error)
    if 1.96 * best.young_modulus_sd > math.log(UNDETERMINED):
        lines = [
            f"None of these pushes determines the modulus of {best.zone} to within a factor of {UNDETERMINED:g}: push farther, or measure "
            "more points, or with less noise. Are all lengths in mm?"
        ]
    else:
        lines = [
            f"Best: {best.push}, {best.points} points, noise {best.noise_mm:g} mm: the least known modulus, that of {best.zone}, to "
            f"{100 * best.error:.2g} % (standard deviation {100 * best.young_modulus_sd:.2g} %, systematic error {100 * best.bias:+.2g} %)."
        ]
    if best.young_modulus_sd > 0.0 and best.noise_sd < 0.5 * best.young_modulus_sd:
        lines.append("There, elements and what is not known of known zones weigh more than noise: more points will help little.")
    touched = "Nothing but the plates touches the object, and the identification is told so (naibu identify --loaded)."
    anywhere = "Forces may act on the whole surface, as naibu identify takes it with fields; with free sides, plan with --plates-only."
    lines.append(
        f"{touched if plates_only else anywhere} Markers between plates whose contact and friction are modelled say at least as much as "
        "the same points with --plates-only. The law, and what is said of zones and known moduli, are taken as true."
    )
    return tuple(lines)


def _cells(row: Planned) -> tuple[Cell, ...]:
    return (
        row.push, row.points, row.noise_mm, row.zone, row.young_modulus, 100.0 * row.young_modulus_sd, 100.0 * row.noise_sd, *row.interval,
        100.0 * row.bias, row.poisson_ratio, row.poisson_ratio_sd,
    )  # fmt: skip


def _written(folder: Path, result: Design, provenance: Mapping[str, object]) -> list[Path]:
    table = result.table()
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in table.rows]
    numbers = {"naibu": __version__, "rows": rows, "in_words": list(result.notes), **provenance}
    text = json.dumps(jsonable(numbers, 17), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    lead = "".join(f"<p{' class=lead' if i == 0 else ''}>{escape(s)}</p>" for i, s in enumerate(result.notes))
    page = page_html("Planned experiment", lead, table_html(table), f"naibu {escape(__version__)}")
    return [write_atomically(folder / "design.html", page), write_atomically(folder / "design.json", text)]
