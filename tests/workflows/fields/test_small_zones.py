"""A zone that is a small part of the object, and ends inside of cubes: nodes follow its borders, and moduli are corrected for the rest."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError
from naibu.core.volume import Volume
from naibu.identification.from_fields.estimate import homogeneous_moduli
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.workflows.fields.block_mesh import blurred
from naibu.workflows.fields.known_zones import parse_known_zones
from naibu.workflows.fields.object_on_cubes import ObjectOnCubes, ScannedObject

NAMES = {1: "gel", 2: "lump"}
SD_MM = 0.03


def cubes(lump: tuple[slice, slice, slice], sd_mm: float | None = SD_MM, size_mm: float = 40.0 / 14.0) -> ObjectOnCubes:
    """Return a cube of 40 mm with a lump on cubes, and a field of bending with noise."""
    labels: IntArray = np.ones((40, 40, 40), dtype=np.int64)
    labels[lump] = 2
    volume = Volume.from_array(np.ones_like(labels, dtype=np.uint8), spacing_mm=(1.0,) * 3, origin_mm=(0.5,) * 3)
    rng = np.random.default_rng(0)
    points = rng.uniform(1.0, 39.0, (4000, 3))
    x, y, z = points.T / 40.0
    moved = 2.0 * np.stack([x * z**2, y * x, -z * (1.0 + 0.2 * y)], axis=1) + SD_MM * rng.standard_normal(points.shape)
    field = DisplacementField.from_arrays(points, moved, sd_mm=sd_mm)
    return ScannedObject(volume, labels, NAMES, (("press", field),), ()).on_cubes(size_mm, (), exactly=True, each_cell=False)


def test_borders_of_a_lump_of_one_part_in_sixty_four_do_not_stay_a_millimetre_off() -> None:
    """Its cubes are a tenth larger than it is and lie a millimetre beside it: a law of another shape seemed to fit such a field better."""
    found = cubes((slice(20, 30), slice(10, 20), slice(20, 30)))
    assert found.wrong < 0.01  # of the object
    assert found.region_at is not None
    nodes = found.mesh.points[found.mesh.cells[found.mesh.regions == 1]].reshape(-1, 3)
    apart = np.abs(np.stack([nodes.min(axis=0), nodes.max(axis=0)]) - [[20.0, 10.0, 20.0], [30.0, 20.0, 30.0]])
    assert np.median(apart) < 0.4
    (told,) = blurred(0.0, found.wrong, found.lost, corrected=True)
    assert "with lump" in told and "moduli are corrected" in told


def test_borders_between_cubes_need_no_correction() -> None:
    found = cubes((slice(20, 40), slice(0, 40), slice(0, 40)))
    assert found.region_at is None and found.lost == {"gel": 0.0, "lump": 0.0}
    assert blurred(0.0, found.wrong, found.lost, corrected=False) == ()


def test_noise_that_is_not_stated_is_that_of_neighbours() -> None:
    """Taken for nearly nothing, it makes the sought motion of the surface follow every error of the measurement."""
    found = cubes((slice(20, 40), slice(0, 40), slice(0, 40)), None)
    covariance = found.load_cases[0].field.covariance
    assert covariance is not None
    assert float(np.median(np.sqrt(covariance[:, 0, 0]))) == pytest.approx(SD_MM, rel=0.1)
    assert any("no standard deviation is stated" in told for told in found.noise)


def test_stated_noise_is_kept() -> None:
    covariance = cubes((slice(20, 40), slice(0, 40), slice(0, 40))).load_cases[0].field.covariance
    assert covariance is not None
    np.testing.assert_allclose(np.sqrt(covariance[:, 0, 0]), SD_MM, rtol=1e-6)


def test_many_cubes_start_from_the_homogeneous_body_of_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2744 cubes the surface has thousands of unknowns; a start is found on 1000 of them."""
    starts = []

    def caught(*args: object, start: tuple[FloatArray, FloatArray] | None, **_: object) -> None:
        starts.append(start)
        raise ConvergenceError("that is enough")

    monkeypatch.setattr("naibu.workflows.fields.object_on_cubes.identify_field", caught)
    monkeypatch.setattr("naibu.workflows.fields.object_on_cubes.MOST_REFINED", 2000)
    monkeypatch.setattr("naibu.workflows.fields.object_on_cubes.CELLS", 200)
    many = cubes((slice(20, 40), slice(0, 40), slice(0, 40)))
    stated = parse_known_zones(["gel=10 kPa, 0.3"], list(NAMES.values()))
    with pytest.raises(ConvergenceError, match="that is enough"):
        many.identified(stated, law="linear", bounds=stated.bounds, each_cell=False, progress=None)
    few = cubes((slice(20, 40), slice(0, 40), slice(0, 40)), size_mm=40.0 / 6.0)
    zones = Zones.of(few.mesh, known=stated.values, known_sd=stated.doubts)
    lame, shear, told = homogeneous_moduli(few.mesh, few.load_cases, zones, law="linear", bounds=stated.bounds)
    assert "homogeneous start" in told
    assert starts[0] is not None
    np.testing.assert_allclose(np.concatenate(starts[0]), [lame, shear], rtol=0.05)
