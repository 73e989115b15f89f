"""Content of the result page: plain frozen records of arrays, text and numbers.

Lengths are in mm. A residual is predicted minus measured position.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from naibu.core.arrays import FloatArray, IntArray, require_shape
from naibu.core.errors import InputError
from naibu.viewer.json_values import jsonable
from naibu.viewer.tables import Table


@dataclass(frozen=True, slots=True)
class Box:
    """A plate or bar, drawn as a box.

    Attributes
    ----------
    centre_mm : tuple of float
        Its centre.
    half_size_mm : tuple of float
        Half edge lengths along x, y, z before it is turned.
    turned : tuple of float
        Unit quaternion (x, y, z, w) by which it is turned about its centre.
    """

    centre_mm: tuple[float, float, float]
    half_size_mm: tuple[float, float, float]
    turned: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """The deformed model at one load step.

    Attributes
    ----------
    label : str
        Label beside the slider, e.g. ``"plate at 43.2 mm"``.
    load_mm : float
        Displacement of the indenter so far, mm.
    surface : ndarray, shape (n, 3)
        Predicted positions of the surface nodes, mm.
    markers : ndarray, shape (k, 3)
        Predicted marker positions, mm.
    indenters : tuple of Box
        Plates or bar at this load; the same number and order in every step.
    """

    label: str
    load_mm: float
    surface: FloatArray
    markers: FloatArray
    indenters: tuple[Box, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One measured state of one experiment, for the 3-D view.

    Attributes
    ----------
    name : str
        Identifier of the scene, unique in a report.
    experiment, state : str
        Labels in the selector.
    faces : ndarray, shape (f, 3), int
        Triangles of the object's outer surface, wound outwards.
    reference_surface : ndarray, shape (n, 3)
        Surface nodes in the reference configuration, mm.
    steps : tuple of Step
        Load steps from unloaded to fully loaded; the last is compared with `measured`.
    marker_ids : ndarray, shape (k,), int
        Marker numbers.
    initial_markers : ndarray, shape (k, 3)
        Marker positions in the reference configuration, mm.
    measured : ndarray, shape (k, 3)
        Marker positions measured in the loaded state, mm; NaN where a coordinate is unknown.
    sd_mm : ndarray, shape (k,)
        Standard deviation of a residual along one axis expected from noise alone, mm.
    layer : ndarray, shape (k,), int
        Number of the marker layer, 0 for the lowest.
    role : str
        Use of the state, in a word or two, e.g. ``"fitted"`` or ``"predicted unseen"``.
    """

    name: str
    experiment: str
    state: str
    faces: IntArray
    reference_surface: FloatArray
    steps: tuple[Step, ...]
    marker_ids: IntArray
    initial_markers: FloatArray
    measured: FloatArray
    sd_mm: FloatArray
    layer: IntArray
    role: str = ""

    def __post_init__(self) -> None:
        if not self.steps:
            raise InputError(f"scene {self.name!r} has no steps; give at least the fully loaded one")
        n, k = len(self.reference_surface), len(self.marker_ids)
        self._check_shapes(n, k)
        if len(self.faces) and (self.faces.min() < 0 or self.faces.max() >= n):
            raise InputError(
                f"scene {self.name!r}: faces refer to nodes {self.faces.min()} to {self.faces.max()}, the surface has 0 to {n - 1}"
            )
        if not np.isfinite(self.reference_surface).all() or not all(np.isfinite(s.surface).all() for s in self.steps):
            raise InputError(f"scene {self.name!r}: every surface coordinate must be a finite number of mm")
        if not np.isfinite(self.initial_markers).all() or not all(np.isfinite(s.markers).all() for s in self.steps):
            raise InputError(
                f"scene {self.name!r}: markers of the steps and initial_markers must be finite; omit markers that cannot be predicted"
            )
        if len({len(s.indenters) for s in self.steps}) > 1:
            raise InputError(f"scene {self.name!r}: every step must have the same number of indenters")

    def _check_shapes(self, n: int, k: int) -> None:
        shapes = {
            "faces": (self.faces, (len(self.faces), 3)),
            "reference_surface": (self.reference_surface, (n, 3)),
            "initial_markers": (self.initial_markers, (k, 3)),
            "measured": (self.measured, (k, 3)),
            "sd_mm": (self.sd_mm, (k,)),
            "layer": (self.layer, (k,)),
        }
        for i, step in enumerate(self.steps):
            shapes[f"steps[{i}].surface"] = (step.surface, (n, 3))
            shapes[f"steps[{i}].markers"] = (step.markers, (k, 3))
        for name, (array, shape) in shapes.items():
            require_shape(f"scene {self.name!r}: {name}", array, shape)

    @property
    def label(self) -> str:
        """Experiment and state in one line."""
        return " · ".join(part for part in (self.experiment, self.state) if part) or self.name

    @property
    def residual_mm(self) -> FloatArray:
        """Predicted minus measured position at full load, shape (k, 3), mm; NaN where not measured."""
        return np.asarray(self.steps[-1].markers - self.measured, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """An estimated parameter with its 95 % confidence interval; an infinite or NaN limit means that the data do not bound it.

    A `note` tells why there is no interval, or where the value is from; `beside` is another interval, under a stricter assumption.
    """

    name: str
    label: str
    estimate: float
    lower: float
    upper: float
    unit: str
    note: str = ""
    beside: str = ""

    @property
    def remarks(self) -> str:
        """Note, and the other interval, as one text."""
        return "; ".join(filter(None, (self.note, self.beside)))


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """Correlation matrix (p, p) of the parameter estimates, and their names (p)."""

    names: tuple[str, ...]
    matrix: FloatArray

    def __post_init__(self) -> None:
        p = len(self.names)
        if np.shape(self.matrix) != (p, p):
            raise InputError(f"a correlation of {p} parameters needs a ({p}, {p}) matrix, not {np.shape(self.matrix)}")


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSet:
    """Residuals of one state, for the plots by marker layer.

    Attributes
    ----------
    title : str
        Heading of the plots.
    residual_mm : ndarray, shape (k, 3)
        Predicted minus measured, mm; NaN where not measured.
    sd_mm : ndarray, shape (k,)
        Standard deviation along one axis expected from noise alone, mm.
    layer : ndarray, shape (k,), int
        Marker layer, 0 for the lowest.
    """

    title: str
    residual_mm: FloatArray
    sd_mm: FloatArray
    layer: IntArray

    @classmethod
    def from_scene(cls, scene: Scene) -> ResidualSet:
        """Return the residuals of a scene at full load."""
        title = f"{scene.label} ({scene.role})" if scene.role else scene.label
        return cls(title, scene.residual_mm, scene.sd_mm, scene.layer)


@dataclass(frozen=True, slots=True)
class VerdictNote:
    """Whether the model explains the data.

    Attributes
    ----------
    sentence : str
        The verdict.
    sound : bool
        Whether nothing speaks against an explanation; the page sets other verdicts off as a warning.
    details : tuple of str
        Reasons, markers that were left out, and what else to know, one sentence each.
    """

    sentence: str
    sound: bool
    details: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """Content of one result page, in reading order.

    Attributes
    ----------
    title : str
        Heading of the page.
    headline : tuple of str
        The main results in sentences; the first is set larger.
    verdict : VerdictNote or None
        Set above the headline.
    scenes : tuple of Scene
        States for the 3-D view and for the RMS bars below the headline.
    accuracy : Table or None
        Experiment, state, markers, RMS along x, y, z and in 3-D, in mm and in noise units, and the baselines.
    residuals : tuple of ResidualSet
        Plots by marker layer.
    parameters : tuple of ParameterRow
        Estimates with intervals; rows of one unit have a common scale.
    correlation : Correlation or None
        Correlation of the estimates.
    undetermined : tuple of str
        What the data do not determine, one sentence each.
    tables : tuple of Table
        Further tables, e.g. the comparison of models.
    provenance : mapping
        Version, settings, hashes of the inputs, seed; mappings may nest.
    """

    title: str
    headline: tuple[str, ...]
    verdict: VerdictNote | None = None
    scenes: tuple[Scene, ...] = ()
    accuracy: Table | None = None
    residuals: tuple[ResidualSet, ...] = ()
    parameters: tuple[ParameterRow, ...] = ()
    correlation: Correlation | None = None
    undetermined: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    provenance: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))


def report_json(report: Report, digits: int = 6) -> str:
    """Return the report as JSON text, floats rounded to `digits` significant digits."""
    return json.dumps(jsonable(report, digits), allow_nan=False, ensure_ascii=False)
