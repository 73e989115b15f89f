"""Run a study of an indentation from its file: page, numbers, and the motion for ParaView."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.vtk_files import write_vtkhdf_series
from naibu.meshing.surface import boundary_faces
from naibu.simulation.adaptive.indentation import Indentation, indent
from naibu.simulation.adaptive.statics import StaticResult
from naibu.viewer.cards import Card
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, force_unit, motion_html
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.indentation_study import PreparedIndentation, prepared_indentation

PAGE_BYTES = 3_000_000


@no_empty_folders()
def simulate_indentation(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False, progress: Progress | None = None
) -> tuple[Path, ...]:
    """Compute a study; write ``NAME.html``, ``NAME.json`` and, for ParaView, ``NAME.vtkhdf``.

    Parameters
    ----------
    source : str or path-like
        ``"indentation"``, or a file.
    out : path-like
        Folder of the files.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` after every mesh.

    Raises
    ------
    InputError
        A file that cannot be used, or a folder that cannot be written to or holds results.
    ConvergenceError
        An equilibrium was not found.
    """
    study = prepared_indentation(source)
    folder = output_folder(out, [f"{study.name}.{ending}" for ending in ("html", "json", "vtkhdf")], overwrite=overwrite)
    refinement = study.settings.refinement
    limit = refinement.max_unknowns

    def told(unknowns: int, found: StaticResult) -> None:
        done = min(1.0, refinement.tolerance / max(found.relative_error, 1e-12), 1.0)
        report_progress(progress, f"simulate {study.name}: {unknowns} unknowns", done=max(done, min(unknowns / limit, 1.0)), total=1.0)

    try:
        result = indent(
            study.mesh, study.materials, study.conditions, study.indenters, study.travel,
            goal=None if refinement.goal == "none" else refinement.goal, tolerance=refinement.tolerance, max_unknowns=limit,
            fraction=refinement.fraction, steps=study.settings.output.steps,
            formulation="mean_dilatation" if study.locks else "standard", callback=told,
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{study.source}: {_in_keys(str(error), len(study.indenters))}") from error
    travel = result.fractions * float(np.linalg.norm(study.travel, axis=1).max())
    page = write_atomically(folder / f"{study.name}.html", motion_html(_page(study, result, travel), PAGE_BYTES))
    numbers = write_atomically(folder / f"{study.name}.json", json.dumps(_numbers(study, result, travel), indent=1) + "\n")
    series = folder / f"{study.name}.vtkhdf"
    write_vtkhdf_series(series, result.mesh, travel, {"displacement_mm": result.displacement})
    return page, numbers, series


def _in_keys(message: str, count: int) -> str:
    for k in range(count):
        message = message.replace(f"indenters[{k}]", f"[[indenter]] number {k + 1}")
    return message


def _numbers(study: PreparedIndentation, result: Indentation, travel: FloatArray) -> dict[str, object]:
    def by_name(values: FloatArray) -> dict[str, object]:
        return {name: values[:, k].tolist() for k, name in enumerate(study.names)}

    return {
        "study": study.title,
        "naibu": __version__,
        "source": study.source,
        "settings": study.settings.model_dump(mode="json", exclude_none=True),
        "inputs_sha256": study.inputs,
        "units": "mm, kPa, mN",
        "nodes": result.mesh.n_points,
        "tetrahedra": result.mesh.n_cells,
        "travel_mm": travel.tolist(),
        "forces_mN": by_name(result.forces),
        "estimated_errors_mN": by_name(result.errors),
        "corrected_forces_mN": by_name(result.corrected),
        "meshes": [
            {
                "unknowns": unknowns,
                "forces_mN": {name: found.reactions[f"indenter {k}"].tolist() for k, name in enumerate(study.names)},
                "relative_error": found.relative_error,
            }
            for unknowns, found in zip(result.refinement.unknowns, result.refinement.rounds, strict=True)
        ],
    }


def _page(study: PreparedIndentation, result: Indentation, travel: FloatArray) -> MotionPage:
    faces = boundary_faces(result.mesh).faces
    nodes, numbers = np.unique(faces, return_inverse=True)
    moved = result.displacement[:, nodes]
    bodies = [RigidShape(n, i.geometry.name, i.geometry.size, i.geometry.axes) for n, i in zip(study.names, study.indenters, strict=True)]
    centres = np.array([i.centre for i in study.indenters])
    positions = centres + result.fractions[:, None, None] * study.travel
    fields = [ColourField("displacement, mm", np.linalg.norm(moved, axis=2))]
    provenance = {
        "naibu": __version__,
        "source": study.source,
        "SHA-256": study.inputs,
        "settings": study.settings.model_dump(mode="json", exclude_none=True),
    }
    return MotionPage(
        study.title, _sentences(study, result), travel, numbers.reshape(-1, 3), result.mesh.points[nodes], moved, fields, bodies,
        positions, travel, result.corrected, (_forces_table(study, result, travel), _meshes_table(study, result)), provenance,
        _cards(study, result), ("travel", "mm"),
    )  # fmt: skip


def _size(force: FloatArray) -> float:
    return float(np.linalg.norm(force))


def _cards(study: PreparedIndentation, result: Indentation) -> tuple[Card, ...]:
    unit, factor = force_unit(float(np.abs(result.corrected[-1]).max()))
    cards = []
    for k, name in enumerate(study.names[:4]):
        force, correction = result.corrected[-1, k], _size(result.errors[-1, k])
        value = f"{factor * _size(force):.4g} {unit}" if force.any() else "no contact"
        share = 100.0 * correction / max(_size(force), 1e-300)
        cards.append(Card(f"Force of {name}", value, f"corrected by {share:.2g} %" if force.any() else ""))
    cards.append(Card("Unknowns", f"{result.refinement.unknowns[-1]}", f"{len(result.refinement.rounds)} meshes"))
    return tuple(cards)


def _sentences(study: PreparedIndentation, result: Indentation) -> list[str]:
    settings, last = study.settings.refinement, result.refinement.result
    reached = last.relative_error <= settings.tolerance
    found = [
        f"{result.mesh.n_points} nodes and {result.mesh.n_cells} tetrahedra, refined in {len(result.refinement.rounds) - 1} rounds from "
        f"{result.refinement.unknowns[0] // 3} nodes. The shown forces are those of the mesh less their estimated errors."
    ]
    what = "the stress, in the energy norm" if settings.goal == "energy" else "the forces, before the correction"
    if settings.goal == "none":
        found.append(f"The mesh was not refined; the forces have an estimated error of {100 * last.relative_error:.2g} %.")
    elif reached:
        found.append(f"The estimated error of {what}, is {100 * last.relative_error:.2g} %; {100 * settings.tolerance:g} % were asked for.")
    else:
        found.append(
            f"Not reached: the estimated error of {what}, is {100 * last.relative_error:.2g} % where {100 * settings.tolerance:g} % were "
            "asked for; allow more unknowns (max_unknowns)."
        )
    if study.rubs:
        found.append("With friction the error is estimated for the last step of the way alone.")
    return found


def _forces_table(study: PreparedIndentation, result: Indentation, travel: FloatArray) -> Table:
    unit, factor = force_unit(float(np.abs(result.corrected).max()))
    columns = ["travel, mm"]
    for name in study.names:
        columns += [f"{name}: force, {unit}", "of the mesh", "estimated error, %"]
    rows: list[tuple[Cell, ...]] = []
    for s, way in enumerate(travel):
        row: list[Cell] = [float(way)]
        for k in range(len(study.names)):
            force, error = _size(result.forces[s, k]), _size(result.errors[s, k])
            row += [factor * _size(result.corrected[s, k]), factor * force, 100.0 * error / force if force else None]
        rows.append(tuple(row))
    note = "The force is that of the mesh less its estimated error along the travel. While few faces touch, it is known badly."
    return Table("Forces", tuple(columns), tuple(rows), note=note)


def _meshes_table(study: PreparedIndentation, result: Indentation) -> Table:
    unit, factor = force_unit(float(np.abs(result.corrected[-1]).max()))
    goal = study.settings.refinement.goal
    error = "estimated error of the stress, %" if goal == "energy" else "estimated error of the forces, %"
    columns = ("unknowns", *(f"{name}: force of the mesh, {unit}" for name in study.names), error)
    rows = tuple(
        (unknowns, *(factor * _size(found.reactions[f"indenter {k}"]) for k in range(len(study.names))), 100.0 * found.relative_error)
        for unknowns, found in zip(result.refinement.unknowns, result.refinement.rounds, strict=True)
    )
    return Table("Meshes", columns, rows, caption="At the end of the way.")
