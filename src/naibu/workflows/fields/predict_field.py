"""Predict the displacement of a body that was identified from displacement fields, compare it with a measured one, and write both."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import LENGTHS_MM, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.identification.from_fields.identified.field_prediction import FieldPrediction, predict_inside, predict_moved_sides
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.verdict import UNDETERMINED
from naibu.io.displacement_fields import read_field, write_field
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record, sha256
from naibu.io.vtk_files import write_vtu
from naibu.meshing.point_location import locate
from naibu.viewer.cards import Card
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_slices
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Table
from naibu.workflows.fields.measured_load_case import relative_deformation
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.results.result_folder import read_identified_body

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FILES = ("predicted.html", "field.h5", "predicted.vtu", "summary.json")
VOXELS = 60_000  # of the grid on which a prediction is written
WIDTH = 1.959964  # standard deviations to either side that hold 95 %
MOST_DEFORMATION = 2.0  # root mean square displacement without the rigid motion, over the extent: of soft bodies hardly ever half of that
EXTRAPOLATED = 1.5  # times the deformation of the identification, from which a prediction is an extrapolation


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A prediction against a measured field, at points from which it was not computed.

    Attributes
    ----------
    points : ndarray, shape (k, 3)
        mm.
    difference : ndarray, shape (k, 3)
        Predicted less measured displacement, mm.
    rms_mm : ndarray, shape (3,)
        Root mean square difference along x, y and z.
    rms_sd : float or None
        Root mean square difference in units of its standard deviation, that of the measurement included; None where that is not known.
    within : float or None
        Part of the components within 1.96 standard deviations.
    identified : bool
        Whether the moduli were identified from this very field, so that the comparison tests nothing.
    """

    points: FloatArray
    difference: FloatArray
    rms_mm: FloatArray
    rms_sd: float | None
    within: float | None
    identified: bool = False

    @classmethod
    def of(cls, prediction: FieldPrediction, field: DisplacementField, *, identified: bool) -> Comparison:
        """Compare at all points of a field."""
        predicted, covariance = prediction.at(field.points)
        difference = predicted - field.vectors
        rms = np.sqrt((difference**2).mean(axis=0))
        if field.covariance is None:
            return cls(field.points, difference, rms, None, None, identified)
        sd = np.sqrt(np.einsum("kii->ki", covariance + field.covariance))
        return cls(
            field.points, difference, rms, float(np.sqrt(((difference / sd) ** 2).mean())), float((np.abs(difference) < WIDTH * sd).mean()),
            identified,
        )  # fmt: skip

    @property
    def role(self) -> str:
        """What the points are to the model."""
        return "of a field from which the model was identified: no test of it" if self.identified else "that were not used"

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as JSON can hold them."""
        return {
            "points": len(self.points),
            "rms_mm": self.rms_mm.tolist(),
            "rms_in_standard_deviations": self.rms_sd,
            "within_95_percent": self.within,
            "identified_the_model": self.identified,
        }

    def sentence(self) -> str:
        """Return the comparison in words."""
        x, y, z = self.rms_mm
        text = f"At {len(self.points)} measured points {self.role}: RMS difference x {x:.3g}, y {y:.3g}, z {z:.3g} mm"
        if self.rms_sd is None or self.within is None:
            return f"{text}; the measured field states no standard deviation."
        return f"{text}, {self.rms_sd:.2f} standard deviations; {100 * self.within:.0f} % of the components lie within the 95 % interval."


@dataclass(frozen=True, slots=True, eq=False)
class FieldPredictionRun(ShownInNotebook):
    """What `predict_field` returns.

    Attributes
    ----------
    body : IdentifiedBody
        The model.
    prediction : FieldPrediction
        Displacement and its covariance.
    comparison : Comparison or None
        With the measured field, where one was given.
    notes : tuple of str
        What the prediction rests on, in words.
    files : tuple of Path
        What was written.
    """

    body: IdentifiedBody
    prediction: FieldPrediction
    comparison: Comparison | None
    notes: tuple[str, ...]
    files: tuple[Path, ...] = ()

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return slices_html(_page(self, on_grid(self.body, self.prediction)))

    def plot(self) -> Canvas:
        """Return a figure of the slice with most of the body: predicted displacement, and its largest standard deviation."""
        field = on_grid(self.body, self.prediction)
        size, sd = np.linalg.norm(field.vectors, axis=-1), field.largest_sd_mm
        assert sd is not None
        z = int(np.argmax(np.isfinite(size).sum(axis=(1, 2))))
        canvas = empty_figure(8.0, 3.6)
        draw_slices(
            canvas, [("displacement (mm)", size[z], "viridis"), ("standard deviation (mm)", sd[z], "cividis")], field.grid.spacing_mm
        )
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a node of the model: its position, predicted displacement, and the standard deviations of that, mm."""
        names = [f"{kind}{axis}_mm" for kind in ("", "u", "sd_") for axis in "xyz"]
        columns = np.hstack([self.prediction.mesh.points, self.prediction.displacement, self.prediction.standard_deviation])
        return tuple(dict(zip(names, row, strict=True)) for row in columns.tolist())


@no_empty_folders()
def predict_field(
    model: IdentifiedBody | str | os.PathLike[str],
    field: str | os.PathLike[str] | None = None,
    *,
    held: Sequence[str] = (),
    moved: Sequence[str] = (),
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> FieldPredictionRun:
    """Predict the displacement of an identified body under another loading, and compare it with a measured one.

    Either sides of the body are held and moved by plates to which they stick, its other surface being free; or the displacement of the
    surface follows from `field` near there, and that inside is predicted.

    Parameters
    ----------
    model : IdentifiedBody or path-like
        ``model.json`` of an identification from displacement fields, or its folder.
    field : path-like, optional
        Measured displacement in the frame of the scan that the model was identified from (see `naibu.io.read_field`).
    held : sequence of str
        Sides that do not move: ``x-``, ``x+``, ``y-``, ``y+``, ``z-``, ``z+`` in the frame of the scan.
    moved : sequence of str
        Sides and their displacement, mm: ``"z+=0,0,-5"``.
    out : path-like, optional
        Folder for ``field.h5``, ``predicted.html``, ``predicted.vtu`` and ``summary.json``.
    overwrite : bool
        Whether these files may be there already.

    Raises
    ------
    InputError
        A model or a field that cannot be used, sides that do not exist, or neither a field nor sides.
    ConvergenceError
        There is no equilibrium.
    """
    body = model if isinstance(model, IdentifiedBody) else read_identified_body(model)
    motions = parsed_sides(held, moved)
    measured = None if field is None else read_field(field).at_points()
    if measured is None and not motions:
        raise InputError("give `moved`, a side of the body and its displacement, or a measured field, whose surface moves the body")
    folder = None if out is None else output_folder(out, FILES, overwrite=overwrite)
    if motions:
        prediction = predict_moved_sides(body, motions)
        compared = None if measured is None else _inside_of(prediction, measured)
    else:
        assert measured is not None
        _require_possible(body, measured)
        prediction, inner = predict_inside(body, measured)
        compared = _part(measured, inner)
    identified = field is not None and _identified_from(body, field)
    comparison = None if compared is None or not len(compared.points) else Comparison.of(prediction, compared, identified=identified)
    notes = _notes(body, prediction, motions, comparison, measured is not None)
    run = FieldPredictionRun(body, prediction, comparison, notes)
    if folder is None:
        return run
    inputs = input_record({"model": None if isinstance(model, IdentifiedBody) else _file_of(model), "field": field})
    return replace(run, files=written_together(folder, FILES, lambda at: _written(at, run, motions, dict(inputs))))


def parsed_sides(held: Sequence[str], moved: Sequence[str], *, argument: str = "moved") -> dict[str, tuple[float, float, float]]:
    """Read ``z-`` and ``z+=0,0,-5``.

    Raises
    ------
    InputError
        A text of another form, or a side that is named twice.
    """
    out: dict[str, tuple[float, float, float]] = {}
    for side, motion in [(text.strip(), (0.0, 0.0, 0.0)) for text in held] + [_motion(argument, text) for text in moved]:
        if side in out:
            raise InputError(f"side {side!r} is named twice; hold it, or move it once")
        out[side] = motion
    return out


def _motion(argument: str, text: str) -> tuple[str, tuple[float, float, float]]:
    side, _, numbers = text.partition("=")
    try:
        x, y, z = (float(part) for part in numbers.split(","))
    except ValueError as error:
        raise InputError(
            f"{argument}={text!r} must name a side and its displacement along x, y and z in mm, such as 'z+=0,0,-5'"
        ) from error
    if not np.abs([x, y, z]).max() <= LENGTHS_MM[1]:
        raise InputError(f"{argument}={text!r}: a displacement must be at most {LENGTHS_MM[1]:g} mm")
    return side.strip(), (x, y, z)


def _identified_from(body: IdentifiedBody, field: str | os.PathLike[str]) -> bool:
    """Whether a file is one of those that the body was identified from, whatever its name."""
    inputs = body.provenance.get("inputs", {})
    return any(str(record).endswith(sha256(field)) for record in inputs.values()) if isinstance(inputs, Mapping) else False


def _file_of(model: str | os.PathLike[str]) -> Path:
    return Path(model) / "model.json" if Path(model).is_dir() else Path(model)


def _near(mesh: Mesh, field: DisplacementField) -> IntArray:
    """Return which valid measurements lie in the box that a body fills."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    return np.flatnonzero(field.valid & ((field.points >= low) & (field.points <= high)).all(axis=1))


def _require_possible(body: IdentifiedBody, field: DisplacementField) -> None:
    """Refuse displacements with which a body would be deformed by more than it is large, as those in another unit do."""
    near = _near(body.mesh, field)
    if len(near) > 2 and (share := relative_deformation(_part(field, near))) > MOST_DEFORMATION:
        raise InputError(
            f"field: its displacements deform the object by {share:.3g} times its size (root mean square, without the rigid motion), which "
            "no body follows: are they in mm, as its positions are? Give the columns their unit, such as 'ux [um]'."
        )


def _part(field: DisplacementField, some: Any) -> DisplacementField:
    covariance = None if field.covariance is None else field.covariance[some]
    return DisplacementField.from_arrays(field.points[some], field.vectors[some], covariance=covariance)


def _inside_of(prediction: FieldPrediction, field: DisplacementField) -> DisplacementField:
    """Return the valid measurements that lie in the body."""
    near = _near(prediction.mesh, field)
    if len(near):
        near = near[locate(prediction.mesh, field.points[near], tolerance_mm=np.inf).distance_mm <= 1e-6]
    if not len(near):
        raise InputError("no measurement of the field lies in the body; are field and model from one reference scan?")
    return _part(field, near)


def _notes(
    body: IdentifiedBody,
    prediction: FieldPrediction,
    motions: dict[str, tuple[float, float, float]],
    comparison: Comparison | None,
    measured: bool,
) -> tuple[str, ...]:
    notes = [f"The model is doubtful: {body.reservation}"] if body.reservation else []
    if motions:
        said = [f"{side} {'held' if not any(u) else f'moved by ({u[0]:g}, {u[1]:g}, {u[2]:g}) mm'}" for side, u in motions.items()]
        notes.append(f"Loading: {', '.join(said)}; these sides stick to their plates, and all other surface is free.")
    else:
        notes.append("Loading: the surface moves as the measured field does in the cells there; nothing measured farther inside was used.")
    if comparison is not None:
        notes.append(comparison.sentence())
    elif measured:
        notes.append("The field has no point farther inside than the cells at the surface: nothing to compare with.")
    sd = float(np.median(prediction.standard_deviation))
    parts = "moduli, surface, elements and model misfit" if body.covariance is not None else "surface, elements and model misfit"
    notes.append(f"A predicted component is known to {sd:.2g} mm (standard deviation, median of all nodes: {parts}).")
    if loose := _undetermined(body):
        notes.append(
            f"It follows from moduli near those used, and is too small where those of {', '.join(loose)}, which the identification leaves "
            "open, are far from them."
        )
    if body.covariance is None:
        notes.append("The model is a map of moduli cell by cell without a covariance: what its errors do to the prediction is not known.")
    if prediction.strain > EXTRAPOLATED * body.strain:
        ratio = prediction.strain / max(body.strain, 1e-300)
        notes.append(f"This is an extrapolation: the body is deformed {ratio:.2g} times as much as in the identification.")
    return tuple(notes)


def _undetermined(body: IdentifiedBody) -> list[str]:
    """Return the zones whose shear modulus is known to no factor of `UNDETERMINED`, within which a prediction is not linear in it."""
    if body.covariance is None:
        return []
    sd = np.sqrt(np.diag(body.covariance)[: len(body.zones)])
    return [zone for zone, s in zip(body.zones, sd, strict=True) if 1.96 * s > np.log(UNDETERMINED)]


def _written(folder: Path, run: FieldPredictionRun, motions: dict[str, tuple[float, float, float]], inputs: dict[str, str]) -> list[Path]:
    """Write field and numbers first, and the page."""
    body, prediction, c = run.body, run.prediction, run.comparison
    field = on_grid(body, prediction)
    provenance = {"naibu": __version__, "verb": "predict", "inputs": inputs}
    files = [write_field(folder / "field.h5", field, provenance=provenance)]
    sd = prediction.standard_deviation
    write_vtu(folder / "predicted.vtu", body.mesh, {"displacement_mm": prediction.displacement, "standard_deviation_mm": sd})
    numbers = {
        "naibu": __version__,
        "loading": {side: list(u) for side, u in motions.items()} or "surface of the field",
        "largest_displacement_mm": float(np.linalg.norm(prediction.displacement, axis=1).max()),
        "median_sd_mm": float(np.median(sd)),
        "deformation": prediction.strain,
        "deformation_in_identification": body.strain,
        "comparison": None if c is None else c.to_dict(),
        "notes": list(run.notes),
        "inputs": inputs,
        "provenance": dict(body.provenance),
    }
    files.append(write_atomically(folder / "summary.json", json.dumps(numbers, indent=1, ensure_ascii=False) + "\n"))
    return [write_atomically(folder / "predicted.html", slices_html(_page(run, field))), *files, folder / "predicted.vtu"]


def on_grid(body: IdentifiedBody, prediction: FieldPrediction) -> DisplacementField:
    """Return the prediction at the voxels of a grid along the axes of the body's cells, with no vector outside of them."""
    along = body.mesh.points @ body.axes
    low, extent = along.min(axis=0), np.ptp(along, axis=0)
    edge = float((extent.prod() / VOXELS) ** (1.0 / 3.0))
    counts = np.maximum(np.round(extent / edge).astype(int), 1)
    spacing = extent / counts
    grid = Volume.from_array(
        np.zeros(counts[::-1], dtype=bool), spacing_mm=spacing, origin_mm=body.axes @ (low + 0.5 * spacing), direction=body.axes
    )
    points = grid.positions().reshape(-1, 3)
    inside = locate(body.mesh, points, tolerance_mm=np.inf).distance_mm <= 1e-6
    vectors, covariance = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    vectors[inside], covariance[inside] = prediction.at(points[inside])
    shape = grid.shape
    return DisplacementField.on_grid(grid, vectors.reshape(*shape, 3), covariance=covariance.reshape(*shape, 3, 3))


def _page(run: FieldPredictionRun, field: DisplacementField) -> SliceView:
    grid, c = field.grid, run.comparison
    size, sd = np.linalg.norm(field.vectors, axis=-1), field.largest_sd_mm
    assert sd is not None
    known = float(np.median(run.prediction.standard_deviation))
    overlays = [Overlay("displacement, mm", size), Overlay("standard deviation, mm", sd)]
    cards = [
        Card("Largest displacement", f"{np.nanmax(size):.3g} mm"),
        Card("Standard deviation of a displacement", f"{known:.2g} mm", "of a component, median of all nodes"),
    ]
    if c is not None:
        overlays.append(Overlay("distance of predicted from measured, mm", _of_voxels(grid, c)))
        rms = float(np.linalg.norm(c.rms_mm))
        said = "" if c.rms_sd is None else f"{c.rms_sd:.2f} standard deviations, at points {c.role}"
        cards.append(Card("Predicted less measured, RMS", f"{rms:.2g} mm", said))
    rows = tuple((name, e, nu) for name, e, nu in run.body.moduli()) if len(run.body.zones) <= 20 else ()
    return SliceView(
        title="Predicted displacement",
        sentences=run.notes,
        spacing_mm=grid.spacing_mm,
        images=[("body", np.where(np.isfinite(size), 1.0, 0.0))],
        displacement=np.asarray(field.vectors @ grid.direction),
        overlays=overlays,
        tables=[Table("Moduli of the model", ("zone", f"Young's modulus, {run.body.unit}", "Poisson's ratio"), rows)] if rows else [],
        origin_mm=grid.origin_mm @ grid.direction,
        direction=grid.direction,
        cards=cards,
    )


def _of_voxels(grid: Volume, compared: Comparison) -> FloatArray:
    """Return the root mean square distance (nz, ny, nx), mm, of the points in every voxel; NaN where there are none."""
    index = np.round(grid.to_index(compared.points)).astype(int)[:, ::-1]
    index = np.clip(index, 0, np.array(grid.shape) - 1)
    flat = np.ravel_multi_index(tuple(index.T), grid.shape)
    total = int(np.prod(grid.shape))
    counts, sums = np.bincount(flat, minlength=total), np.bincount(flat, (compared.difference**2).sum(axis=1), minlength=total)
    return np.asarray(np.where(counts > 0, np.sqrt(sums / np.maximum(counts, 1)), np.nan).reshape(grid.shape))
