"""A covering thinner than cubes, such as skin: left out and said to be undetermined, while what lies below is identified."""

from __future__ import annotations

import json
import zlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.element_conversion import to_quadratic
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.primitives import box_from_coordinates
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import boundary_nodes
from naibu.workflows.fields.block_mesh import ZoneTooThin
from naibu.workflows.fields.identify_fields import identify_fields
from naibu.workflows.fields.thin_coverings import loaded_below, mesh_on_what_is_left, without_thin_coverings

RADIUS_MM, SKIN_MM, LENGTH_MM = 20.0, 1.5, 40.0
NAMES = {1: "core", 2: "layer", 3: "skin"}
TRUTH = {"core": (9.0, 0.45), "layer": (4.0, 0.45), "skin": (120.0, 0.45)}
SD_MM = 0.02


def in_cylinder(points: FloatArray, skin_mm: float = SKIN_MM) -> IntArray:
    """Return labels of a cylinder along z of two materials side by side in a skin: 0 outside."""
    radius = np.hypot(points[:, 0], points[:, 1])
    soft = np.where(points[:, 0] < 1.0, 1, 2)
    return np.asarray(np.where(radius > RADIUS_MM, 0, np.where(radius > RADIUS_MM - skin_mm, 3, soft)))


def cylinder(skin_mm: float = SKIN_MM) -> Volume:
    count = (42, 42, 40)
    grid = Volume.from_array(np.zeros(count[::-1], np.uint8), spacing_mm=(1.0,) * 3, origin_mm=(-20.5, -20.5, 0.5))
    return grid.with_values(in_cylinder(grid.positions().reshape(-1, 3), skin_mm).reshape(grid.shape).astype(np.uint8))


def inside(labels: Volume) -> Volume:
    return labels.with_values((labels.values > 0).astype(np.uint8))


def test_a_thin_skin_is_left_out_and_a_thick_one_is_not() -> None:
    for skin_mm, out in ((1.5, ("skin",)), (8.0, None)):
        labels = cylinder(skin_mm)
        numbers = labels.values.astype(np.int64)
        left, names, covering = without_thin_coverings(inside(labels), numbers, NAMES, {"layer", "skin"}, 5.0, exactly=False, most=1000)
        assert (None if covering is None else covering.names) == out
        if covering is not None:
            assert covering.thickness_mm[0] == pytest.approx(skin_mm, rel=0.2)
            assert (
                names == {1: "core", 2: "layer"}
                and not (left.values[numbers == 3]).any()
                and (left.values == 1).sum() == (numbers % 3 > 0).sum()
            )


def test_a_thin_skin_of_known_modulus_is_left_out_unless_it_alone_sets_the_scale() -> None:
    labels = cylinder()
    numbers = labels.values.astype(np.int64)
    for known, out in ((("core", "skin"), ("skin",)), (("skin",), None)):
        sought = set(NAMES.values()) - set(known)
        covering = without_thin_coverings(inside(labels), numbers, NAMES, sought, 5.0, exactly=False, most=1000, known=known)[2]
        assert (None if covering is None else covering.names) == out


def test_a_thin_zone_that_does_not_cover_or_is_all_that_is_sought_is_refused() -> None:
    labels = cylinder()
    numbers = labels.values.astype(np.int64)
    with pytest.raises(ZoneTooThin, match="'skin'"):
        without_thin_coverings(inside(labels), numbers, NAMES, {"skin"}, 5.0, exactly=True, most=1000)
    x, y, _ = labels.positions().reshape(-1, 3).T
    numbers = np.where(np.abs(np.hypot(x, y) - 12.0) < 0.7, 3, np.where(np.hypot(x, y) < RADIUS_MM, np.where(x < 1.0, 1, 2), 0))
    with pytest.raises(InputError, match="zone 'skin' and its cubes"):
        without_thin_coverings(inside(labels), numbers.reshape(labels.shape), NAMES, {"layer", "skin"}, 5.0, exactly=True, most=1000)


def test_cells_below_a_skin_end_on_its_inner_side_and_carry_unknown_forces_there() -> None:
    """Nodes of the side of a cylinder lie on a circle, where those of cubes are half a cube beside it."""
    labels = cylinder()
    numbers = labels.values.astype(np.int64)
    left, names, covering = without_thin_coverings(inside(labels), numbers, NAMES, {"layer"}, 5.0, exactly=False, most=1000)
    assert covering is None  # the skin is not sought
    left, names, covering = without_thin_coverings(inside(labels), numbers, NAMES, {"layer", "skin"}, 5.0, exactly=False, most=1000)
    assert covering is not None
    mesh, cell_of_voxel = mesh_on_what_is_left(left, numbers, names, {"layer"}, 5.0, covering.voxels, exactly=True)
    assert mesh.region_names == ("core", "layer") and (cell_of_voxel[covering.voxels] < 0).all()
    assert signed_volumes(mesh).sum() == pytest.approx(np.pi * (RADIUS_MM - SKIN_MM) ** 2 * LENGTH_MM, rel=0.08)
    radius = np.hypot(*mesh.points[:, :2].T)
    side = np.intersect1d(boundary_nodes(mesh), np.flatnonzero(np.abs(mesh.points[:, 2] - 0.5 * LENGTH_MM) < 0.4 * LENGTH_MM))
    assert np.median(np.abs(radius[side] - (RADIUS_MM - SKIN_MM))) < 0.3
    loaded = loaded_below(mesh, covering.voxels, left)
    assert loaded[side].mean() > 0.95 and not loaded[radius < 10.0].any()


@cache
def pushed() -> tuple[Mesh, FloatArray]:
    """Return quadratic tetrahedra of a bar of two materials in a skin, held at an end and pushed at a side, and their displacement."""
    across = np.array([0.0, 1.0, 7.0, 14.0, 20.0, 26.0, 33.0, 39.0, 40.0])
    linear = box_from_coordinates(across, across, np.linspace(0.0, LENGTH_MM, 9), cell_type="tetra")
    x, y, _ = linear.points[linear.cells].mean(axis=1).T
    soft = np.where(x < 20.0, 0, 1)
    regions = np.where(np.maximum(np.abs(x - 20.0), np.abs(y - 20.0)) > 19.0, 2, soft)
    mesh = to_quadratic(Mesh.from_arrays(linear.points, linear.cells, "tetra", regions=regions, region_names=tuple(TRUTH)))
    materials = [material("neo_hookean", young_modulus=e, poisson_ratio=nu) for e, nu in TRUTH.values()]
    body = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, materials)
    x, y, z = mesh.points.T
    plate = (y > 39.9) & (np.abs(x - 20.0) < 14.0) & (np.abs(z - 20.0) < 11.0)
    held = PrescribedDisplacement.none(mesh.n_points).and_also(np.flatnonzero((z < 0.1) | (y < 0.1)), (0.0, 0.0, 0.0))
    held = held.and_also(np.flatnonzero(plate & (z > 0.1)), (1.0, -3.0, 0.5))
    return mesh, solve(Problem(mesh.points, body, (), held, np.zeros_like(mesh.points))).displacement


@pytest.mark.parametrize("seed", [0, 1])
def test_moduli_below_a_thin_skin_are_found_and_that_of_the_skin_is_not(tmp_path: Path, seed: int) -> None:
    """Skin thirty times as stiff as what it covers, of a millimetre, in cubes of six; all forces on the surface are unknown."""
    mesh, u = pushed()
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.1, 39.9, (3000, 3))
    moved = interpolation_operator(mesh, points) @ u + SD_MM * rng.standard_normal(points.shape)
    write_field(tmp_path / "field.h5", DisplacementField.from_arrays(points, moved, sd_mm=SD_MM))
    _, y, x = np.indices((40, 40, 40)) + 0.5
    skin = np.maximum(np.abs(x - 20.0), np.abs(y - 20.0)) > 19.0
    labels = Volume.from_array(np.where(skin, 3, np.where(x < 20.0, 1, 2)).astype(np.uint8), spacing_mm=(1.0,) * 3, origin_mm=(0.5,) * 3)
    write_volume(tmp_path / "labels.mha", labels)
    run = identify_fields(
        tmp_path / "field.h5", zones=tmp_path / "labels.mha", zone_names=NAMES, known=["core=9 kPa, 0.45"], element_size_mm=6.5,
        out=tmp_path / "found",
    )  # fmt: skip
    rows = {row["zone"]: row for row in json.loads((tmp_path / "found" / "identification.json").read_text())["zones"]}
    assert rows["layer"]["95 % from"] < TRUTH["layer"][0] < rows["layer"]["to"] < 2.0 * rows["layer"]["95 % from"]
    assert rows["skin"]["Young's modulus is"] == "not determined" and rows["skin"]["to"] is None
    assert "the modulus of skin is not determined" in run.notes[0] and "mm thick, covers the object" in " ".join(run.notes)
    header, packed = (tmp_path / "found" / "young_modulus.mha").read_bytes().split(b"LOCAL\n")
    assert b"MET_FLOAT" in header
    young = np.frombuffer(zlib.decompress(packed), "<f4").reshape(skin.shape)
    assert np.isnan(young[skin]).all() and np.isfinite(young[~skin]).all()
    assert "the modulus of skin is not determined" in run.body.reservation
