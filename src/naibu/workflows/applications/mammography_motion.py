"""Page of a breast in 3-D: unloaded, between the plates in CC, and in MLO."""

from __future__ import annotations

import numpy as np

from naibu.applications.mammography.breast_mesh import breast_nodes, unit_breast_mesh
from naibu.applications.mammography.mechanical_model import view_axes
from naibu.applications.mammography.two_views import TwoViews
from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.meshing.surface import faces_of_cells, triangles_of_faces
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, motion_html

_EDGE = 0.16  # of the faces, in a half ball of radius 1
_FRAMES = 8  # from unloaded to pressed
_BYTES = 4_000_000
_RADIUS_MM = 2.0


def breast_page(views: TwoViews, angle_deg: float, points: FloatArray, notice: str, provenance: dict[str, object]) -> str:
    """Return the page of a breast and of points (k, 3) in it, mm: a lesion, or the points of an epipolar curve.

    The breast is pressed in CC, released, pressed in MLO, and released.
    """
    ball = unit_breast_mesh(_EDGE)
    mesh = Mesh(breast_nodes(views.shape, ball.points), ball.cells, ball.cell_type, ball.regions, ball.region_names)
    lateral = bool(points[:, 0].mean() > 0.0) if len(points) else True
    shown = (ball.points[ball.cells].mean(axis=1)[:, 0] < 0.0) == lateral  # the half with the points is cut away: it would hide them
    faces = triangles_of_faces(faces_of_cells(mesh.cells[shown], mesh.cell_type).faces)
    used, numbers = np.unique(faces, return_inverse=True)
    skin = mesh.points[used]
    way = np.concatenate([np.linspace(0.0, 1.0, _FRAMES), np.ones(2), np.linspace(1.0, 0.0, _FRAMES)])
    skin_motion: list[FloatArray] = []
    point_motion: list[FloatArray] = []
    for view, angle in ((views.cc, 0.0), (views.mlo, angle_deg)):
        for start, motion in ((skin, skin_motion), (points, point_motion)):
            seen = view.compress(start)
            along, press = view_axes(angle)
            moved = np.outer(seen[:, 0], along) + np.outer(seen[:, 1], press) + np.outer(seen[:, 2], [0.0, 0.0, 1.0]) - start
            motion.append(way[:, None, None] * moved)
    displacement = np.concatenate(skin_motion)
    page = MotionPage(
        title="Breast in both views",
        sentences=(
            notice,
            "Unloaded, pressed in CC, released, pressed in MLO. x laterally, y upwards, z away from the chest wall. The half "
            "with the points is cut away.",
        ),
        times=np.arange(len(displacement), dtype=float),
        faces=numbers.reshape(faces.shape),
        reference=skin,
        displacement=displacement,
        fields=(ColourField("displacement, mm", np.linalg.norm(displacement, axis=2)),),
        bodies=tuple(RigidShape(f"point {k + 1}", "sphere", np.full(3, _RADIUS_MM), np.eye(3)) for k in range(len(points))),
        positions=np.concatenate(point_motion) + points,
        force_times=np.zeros(0),
        force=np.zeros((0, len(points), 3)),
        provenance=provenance,
    )
    return motion_html(page, _BYTES)
