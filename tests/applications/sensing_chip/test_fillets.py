"""Fillets of a chip against the handbook's factor of a shoulder, equilibrium of the ends of the beams, and what the corners bear."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import ChipDesign, assumed_chip
from naibu.applications.sensing_chip.fillets import FilletedEnd, end_loads, end_mesh, filleted_end, require_bearable_at_fillets
from naibu.applications.sensing_chip.finite_elements import ChipResponse, solve_chip
from naibu.applications.sensing_chip.load_envelope import load_limits
from naibu.core.errors import InputError
from naibu.meshing.surface import boundary_faces

RADIUS = 0.03


@pytest.fixture(scope="module")
def beams() -> ChipResponse:
    return solve_chip(assumed_chip(), ChipResolution(8, 2, 2), whole=False)


@pytest.fixture(scope="module")
def end() -> FilletedEnd:
    return filleted_end(assumed_chip(), RADIUS, fineness=2)


def shoulder_factor(high: float, low: float, radius: float) -> float:
    """Roark's factor of a flat bar with a square shoulder and fillets under bending in its plane, for h / r from 2 to 20."""
    h = 0.5 * (high - low)
    root, ratio, depth = np.sqrt(h / radius), h / radius, 2.0 * h / high
    assert 2.0 <= ratio <= 20.0
    terms = (
        1.042 + 0.982 * root - 0.036 * ratio,
        -3.599 + 1.619 * root - 0.431 * ratio,
        6.084 - 5.607 * root + 1.158 * ratio,
        -2.527 + 3.006 * root - 0.691 * ratio,
    )
    return float(sum(c * depth**k for k, c in enumerate(terms)))


def test_a_plate_with_a_shoulder_has_the_factor_of_the_handbook(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block as thin as its beams is a flat bar with a shoulder, bent in its plane; isotropic, as the handbook supposes."""
    eye = np.eye(3)
    shear, poisson = 70e6, 0.25
    first = 2.0 * shear * poisson / (1.0 - 2.0 * poisson)
    swapped = np.einsum("ik,jl->ijkl", eye, eye) + np.einsum("il,jk->ijkl", eye, eye)
    tensor = first * np.einsum("ij,kl->ijkl", eye, eye) + shear * swapped
    monkeypatch.setattr(ChipDesign, "stiffness_tensor", property(lambda self: tensor))
    thin = dataclasses.replace(assumed_chip(), block_height_mm=0.074)
    found = filleted_end(thin, RADIUS, fineness=3)
    bent = found.stress[0, 5] * thin.beam_width_mm**2 * thin.beam_thickness_mm / 6.0
    factor = float(np.linalg.eigvalsh(bent)[..., 2].max())
    assert factor == pytest.approx(shoulder_factor(2.0 * thin.block_half_width_mm, thin.beam_width_mm, RADIUS), rel=0.05)


def test_the_mesh_has_the_fillet(end: FilletedEnd) -> None:
    """Its surface beside and below the beam lies on the quarter circle."""
    design, mesh = end.design, end_mesh(end.design, RADIUS, 2)
    points = mesh.points[np.unique(boundary_faces(mesh).faces)]
    half = 0.5 * design.beam_width_mm
    beside = points[(points[:, 0] > 1e-9) & (points[:, 0] < RADIUS - 1e-9) & (points[:, 1] > half + 1e-9) & (points[:, 2] > 0.0)]
    on_top = np.isclose(beside[:, 2], 0.5 * design.beam_thickness_mm)
    beside = beside[~on_top]
    assert len(beside) > 5
    away = np.hypot(beside[:, 0] - RADIUS, beside[:, 1] - half - RADIUS)
    assert away == pytest.approx(RADIUS, rel=1e-9)
    wall = points[(points[:, 1] > half + RADIUS + 1e-9) & (points[:, 0] > points[:, 0].min() + 0.1)]
    assert len(wall) > 10 and wall[:, 0].max() == pytest.approx(0.0, abs=1e-12)


def test_what_the_beams_exert_on_the_block_is_the_load(beams: ChipResponse) -> None:
    """Forces and moments about the block's centre of the four inner ends balance the load, whose F_z presses down."""
    design = beams.design
    total = np.zeros((6, 6))
    for k, (side, resultants) in enumerate(end_loads(beams)):
        if k % 2 == 0:
            continue  # on the frame
        along = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]][side])
        axes = np.array([along, np.cross([0, 0, 1.0], along), [0, 0, 1.0]])
        force, moment = resultants[:, :3] @ axes, resultants[:, 3:] @ axes
        total += np.concatenate([force, moment + np.cross(design.block_half_width_mm * along, force)], axis=1)
    assert -total == pytest.approx(np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0]), abs=2e-3)


def test_corners_bear_less_than_nominal_and_more_when_rounder(beams: ChipResponse, end: FilletedEnd) -> None:
    rounder = filleted_end(assumed_chip(), 0.05, fineness=2)
    nominal = load_limits(assumed_chip())
    assert (end.load_limits(beams) < rounder.load_limits(beams)).all() and (rounder.load_limits(beams) < nominal).all()
    assert (end.concentration(beams) > 1.2).all() and (end.concentration(beams) < 2.0).all()
    # away from the corner the surface has the nominal stress of bending
    top = np.isclose(end.points[:, 1], 0.0) & np.isclose(end.points[:, 2], 0.037) & (end.points[:, 0] > 0.08)
    bending = end.stress[0, 4, top, 0, 0] * float(end.design.closed_forms.section_modulus)
    assert bending == pytest.approx(1.0, rel=0.03)


def test_at_the_envelope_the_corners_reach_the_strength(beams: ChipResponse, end: FilletedEnd) -> None:
    force, moment = end.envelope(beams, count=5).T
    limits = end.load_limits(beams)
    assert force[0] == pytest.approx(limits[0]) and moment[-1] == pytest.approx(limits[1], rel=1e-6)
    loads = np.zeros((20, 6))
    for k, (a, b) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        loads[5 * k : 5 * k + 5, 2], loads[5 * k : 5 * k + 5, 3] = a * force, b * moment
    worst = end.largest_stress(beams, loads).reshape(4, 5).max(axis=0)
    assert worst == pytest.approx(end.design.strength_kpa)
    inside = np.array([0.0, 0.0, 0.5 * force[2], 0.5 * moment[2], 0.0, 0.0])
    assert require_bearable_at_fillets(end, beams, inside) <= 0.5 + 1e-9
    with pytest.raises(InputError, match=r"fillets of 30 um to .* GPa.*or the fillets larger"):
        require_bearable_at_fillets(end, beams, 3.0 * inside)


def test_fillets_that_do_not_fit_are_refused(beams: ChipResponse) -> None:
    for radius, told in ((-1.0, "must be positive"), (0.09, "along the beams"), (0.11, "between the beams' side and the block's corner")):
        with pytest.raises(InputError, match=told):
            filleted_end(assumed_chip(), radius)
    low = dataclasses.replace(assumed_chip(), block_height_mm=0.1)
    with pytest.raises(InputError, match="below the beams"):
        filleted_end(low, 0.03)
    whole = dataclasses.replace(beams, clamp_loads=np.full_like(beams.clamp_loads, np.nan))
    with pytest.raises(InputError, match="whole=False"):
        end_loads(whole)
