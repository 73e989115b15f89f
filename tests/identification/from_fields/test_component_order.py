"""Fields whose components have other signs or another order than positions, and true fields of uneven bodies, by elements not ours.

The fields are those of quadratic hexahedra at points that are no nodes, with noise (`naibu.validation.specimens.quadratic_body`).
"""

from __future__ import annotations

import numpy as np
import pytest
from uneven_bodies import BODIES, NOISE, field_of

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.component_order import LikelierOrder, likelier_order
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.meshing.surface import boundary_nodes

PUSH, SLANTED = (0.0, 0.0, -4.0), (2.0, -1.0, -3.0)


def judged(name: str, push: tuple[float, float, float], matrix: np.ndarray) -> LikelierOrder | None:
    mesh, loaded, points, u = field_of(name, push)
    field = DisplacementField.from_arrays(points, u @ matrix.T, sd_mm=NOISE * float(np.abs(u).max()))
    return likelier_order(mesh, [FieldLoadCase.of("push", field, mesh, loaded=loaded)])


@pytest.mark.parametrize("push", [PUSH, SLANTED])
@pytest.mark.parametrize("name", BODIES)
def test_true_fields_of_uneven_bodies_are_not_accused(name: str, push: tuple[float, float, float]) -> None:
    assert judged(name, push, np.eye(3)) is None


@pytest.mark.parametrize("name", ["alike", "barrel"])
@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1.0, -1.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.diag([-1.0, -1.0, 1.0]),
        np.eye(3)[[2, 1, 0]],
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    ],
    ids=["z down", "y down", "RAS", "z, y, x", "y upwards"],
)
def test_components_of_another_frame_are_told_with_what_mends_them(name: str, matrix: np.ndarray) -> None:
    found = judged(name, SLANTED, matrix)
    assert found is not None
    assert found.least < 0.6 * found.unexplained
    mended = [m @ matrix for m in found.arrangements]
    assert any(np.array_equal(m, sign * np.eye(3)) for m in mended for sign in (1.0, -1.0))


def test_forces_at_a_side_that_is_called_free_are_not_taken_for_another_frame() -> None:
    mesh, loaded, points, u = field_of("alike", PUSH)
    field = DisplacementField.from_arrays(points, u, sd_mm=0.04)
    top = loaded & (mesh.points[:, 2] > mesh.points[:, 2].mean())
    assert likelier_order(mesh, [FieldLoadCase.of("push", field, mesh, loaded=top)]) is None


def test_nothing_is_decided_where_forces_may_act_on_the_whole_surface() -> None:
    mesh, _, points, u = field_of("alike", PUSH)
    field = DisplacementField.from_arrays(points, u * [1.0, 1.0, -1.0], sd_mm=0.04)
    surface = np.isin(np.arange(mesh.n_points), boundary_nodes(mesh))
    assert likelier_order(mesh, [FieldLoadCase.of("push", field, mesh, loaded=surface)]) is None
