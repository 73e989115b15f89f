"""Points of a scan in both mammograms, on virtual breasts: as in Figures 3 to 7 of the paper, where one patient's lesion was looked at.

The breasts are pressed by other finite elements and another law than those that predict. The prediction knows two projections of the
unloaded breast, the stated distances of the plates and angle, and, where it is constrained, the outlines in the mammograms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.mammography.breast_from_projections import breast_in_projections
from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline
from naibu.applications.mammography.breast_shape import BreastShape
from naibu.applications.mammography.epipolar import Model
from naibu.applications.mammography.pair_construction import mammographic_pair, pair_of_shape
from naibu.core.arrays import FloatArray
from naibu.meshing.surface import boundary_faces, level_extents
from naibu.validation.specimens.half_ball_mesh import unstructured_half_ball
from naibu.validation.specimens.virtual_breasts import VirtualBreast, breast_points, press_breast, random_breast

SEEDS = (200, 201, 202)
IN_SCAN, GEOMETRIC, EQUILIBRIUM, CONSTRAINED = (
    "where it is in the scan",
    "sections that bend, in closed form",
    "equilibrium",
    "equilibrium, on the outlines of the mammograms",
)
_MODELS: dict[str, tuple[Model, bool]] = {
    GEOMETRIC: ("geometric", False),
    EQUILIBRIUM: ("mechanical", False),
    CONSTRAINED: ("mechanical", True),
}
_POINTS = 40
_CELL, _SURFACE_CELL = 0.25, 0.12  # edges in a half ball of radius 1: of the pressed breast, and of the projected surface
_DRAWS = 20
_LEVELS = 60


@dataclass(frozen=True, slots=True, eq=False)
class ScannedBreastStudy:
    """One virtual breast.

    Attributes
    ----------
    outlines : (BreastOutline, BreastOutline)
        In CC and MLO.
    truth : ndarray, shape (2, k, 2)
        Places of the points in both views: depth and position along the chest wall, mm.
    predicted : dict of str to ndarray, shape (2, k, 2)
        Places by each prediction.
    curve_mm : ndarray, shape (k,)
        Distances of the places in MLO from the epipolar curves of those in CC, by the geometric model from the outlines alone.
    wider : dict of str to ndarray, shape (2,)
        Width of the outline along the chest wall in each view over that of the unloaded breast: true, and by each prediction.
    """

    outlines: tuple[BreastOutline, BreastOutline]
    truth: FloatArray
    predicted: dict[str, FloatArray]
    curve_mm: FloatArray
    wider: dict[str, FloatArray]

    def distances(self, name: str) -> FloatArray:
        """Return the distances (2, k) of the predicted from the true places, mm."""
        return np.asarray(np.linalg.norm(self.predicted[name] - self.truth, axis=2))


def scanned_breast_study(seed: int) -> ScannedBreastStudy:
    """Press a virtual breast, and predict where points of its scan appear.

    Parameters
    ----------
    seed : int
        Of the breast.
    """
    breast = random_breast(seed)
    pressed = press_breast(breast, count=_POINTS, cell=_CELL)
    outlines = breast_outline(pressed.outlines[0]), breast_outline(pressed.outlines[1])
    shape = _scanned_shape(breast)
    seen = np.all(pressed.places[:, :, 0] > 0.0, axis=0)
    points = pressed.points[seen]
    truth = np.stack([o.from_image(places[seen]) for o, places in zip(outlines, pressed.places, strict=True)])
    angles, plates = (0.0, breast.stated_angle_deg), breast.stated_thickness_mm
    turns = np.deg2rad(angles)
    unmoved = [np.column_stack([points[:, 2], points[:, 0] * np.cos(t) + points[:, 1] * np.sin(t)]) for t in turns]
    predicted = {IN_SCAN: np.stack(unmoved)}
    own = np.array([2.0 * float(np.sqrt(shape.in_view(a, shape.depths)[1][:, 0].max())) for a in angles])
    wider = {"true": np.array([np.ptp(o.polygon[:, 1]) for o in outlines]) / own, IN_SCAN: np.ones(2)}
    for name, (model, constrained) in _MODELS.items():
        pair = pair_of_shape(shape, plates, angles[1], outlines=outlines, constrain_outlines=constrained, model=model, draws=_DRAWS)
        views = pair.nominal.cc, pair.nominal.mlo
        predicted[name] = np.stack([view.project(points) for view in views])
        wider[name] = np.array([np.ptp(view.outline()[:, 1]) for view in views]) / own
    pair = mammographic_pair(*outlines, plates, angles[1], draws=_DRAWS)
    curves = [pair.epipolar_curve(cc).distance(mlo) for cc, mlo in zip(*truth, strict=True)]
    return ScannedBreastStudy(outlines, truth, predicted, np.array(curves), wider)


def _scanned_shape(breast: VirtualBreast) -> BreastShape:
    """Return the shape that two projections of the unloaded breast show."""
    unit = unstructured_half_ball(_SURFACE_CELL)
    points, faces = breast_points(breast, unit.points), boundary_faces(unit).faces
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    depths = breast.depth_mm * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, _LEVELS))
    projections = []
    for axis in (0, 1):
        flat = points[:, [2, axis]]
        low, high = level_extents(flat[edges[:, 0]], flat[edges[:, 1]], depths)
        projections.append(breast_outline(np.vstack([np.column_stack([depths, low]), np.column_stack([depths, high])[::-1]])))
    return breast_in_projections(projections[0], projections[1]).shape
