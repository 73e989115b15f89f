"""The sign of one component is told from the change of volume of the field; no true field of an uneven body is accused.

The fields are those of quadratic hexahedra at points that are no nodes, with noise (`naibu.validation.specimens.quadratic_body`).
"""

from __future__ import annotations

import numpy as np
import pytest
from uneven_bodies import BODIES, NOISE, field_of

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.volume_change import VolumeChange, volume_change
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes

PUSHES = ((0.0, 0.0, -4.0), (2.0, -1.0, -3.0), (0.0, 0.0, 5.0), (4.0, 0.0, 0.0), (-2.0, 3.0, 1.0))
HARDLY_COMPRESSIBLE = ("alike", "soft below", "stiff lump", "lumps", "barrel", "tapered")


def found(name: str, push: tuple[float, float, float], matrix: np.ndarray) -> VolumeChange:
    mesh, _, points, u = field_of(name, push)
    field = DisplacementField.from_arrays(points, u @ matrix.T, sd_mm=NOISE * float(np.abs(u).max()))
    everywhere = np.isin(np.arange(mesh.n_points), boundary_nodes(mesh))
    return volume_change(mesh, FieldLoadCase.of("push", field, mesh, loaded=everywhere))


@pytest.mark.parametrize("reverse", [1.0, -1.0])
@pytest.mark.parametrize("push", PUSHES)
@pytest.mark.parametrize("name", BODIES)
def test_true_fields_are_not_accused(name: str, push: tuple[float, float, float], reverse: float) -> None:
    judged = found(name, push, reverse * np.eye(3))
    assert not judged.wrong_sign
    assert judged.given < 2.5 * judged.flipped
    if name in HARDLY_COMPRESSIBLE:
        assert not judged.doubtful_order


@pytest.mark.parametrize("component", range(3))
@pytest.mark.parametrize("push", [(0.0, 0.0, -4.0), (2.0, -1.0, -3.0), (0.0, 0.0, 5.0)])
@pytest.mark.parametrize("name", HARDLY_COMPRESSIBLE)
def test_a_changed_sign_is_told_with_the_component(name: str, push: tuple[float, float, float], component: int) -> None:
    """Two of them are the third one and all reversed."""
    one = np.where(np.arange(3) == component, -1.0, 1.0)
    for signs in (one, -one):
        judged = found(name, push, np.diag(signs))
        assert judged.wrong_sign
        assert judged.component == component


def test_another_order_of_a_gel_is_doubted() -> None:
    judged = found("alike", (2.0, -1.0, -3.0), np.eye(3)[[2, 1, 0]])
    assert judged.doubtful_order
    assert any(np.array_equal(judged.order @ np.eye(3)[[2, 1, 0]], sign * np.eye(3)) for sign in (1.0, -1.0))


def test_a_shear_of_a_gel_tells_no_signs() -> None:
    """Sheared to and fro it is the same body."""
    assert not found("alike", (4.0, 0.0, 0.0), np.eye(3)).signs_told
    assert found("alike", (0.0, 0.0, -4.0), np.eye(3)).signs_told


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("turn", [0.0, 0.15])
def test_noise_of_a_bent_or_turned_plate_is_no_change_of_volume(turn: float, seed: int) -> None:
    """Rivlin's bending of a block changes no volume; strains of the plate are of the size of the noise, its turns far larger."""
    mesh = box((80.0, 60.0, 9.0), (14, 11, 2), centred=False)
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.0, 0.0, 0.0], [80.0, 60.0, 9.0], (1400, 3))
    x, y, z = points.T
    radius, angle = 500.0, x / 500.0
    r = np.sqrt(2.0 * radius * z + radius**2)
    bent = np.stack([r * np.sin(angle), y, r * np.cos(angle) - radius], axis=1)
    u = bent @ rotation(turn).T - points
    field = DisplacementField.from_arrays(points, u + 0.05 * rng.standard_normal(u.shape), sd_mm=0.05)
    everywhere = np.isin(np.arange(mesh.n_points), boundary_nodes(mesh))
    judged = volume_change(mesh, FieldLoadCase.of("bent", field, mesh, loaded=everywhere))
    assert not judged.wrong_sign and not judged.doubtful_order


def rotation(angle: float) -> np.ndarray:
    """Return the rotation about y by an angle, rad."""
    return np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
