"""Maps of noisy fields have cubes as large as noise asks for: by the variance of a slope in closed form, and on data of other code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import QuadraticBody
from naibu.workflows.fields.cells_of_map import FEWEST, LEAST_OF_MAP, NOISE_OF_STRAIN, cubes_of_map, noise_mm
from naibu.workflows.fields.identify_fields import identify_fields
from naibu.workflows.fields.object_on_cubes import ScannedObject

SIZE_MM = 40.0


def scanned(strain: float, noise_mm: float, points: int, *, stated: bool = True, seed: int = 0) -> ScannedObject:
    """Return a cube squeezed along z by a strain, at constant volume, measured with noise."""
    rng = np.random.default_rng(seed)
    inside = Volume.from_array(np.ones((20, 20, 20), dtype=np.uint8), spacing_mm=(2.0,) * 3, origin_mm=(1.0,) * 3)
    p = rng.uniform(0.0, SIZE_MM, (points, 3))
    u = p * strain * np.array([0.5, 0.5, -1.0]) + noise_mm * rng.standard_normal(p.shape)
    field = DisplacementField.from_arrays(p, u, sd_mm=noise_mm if stated else None)
    return ScannedObject(inside, inside.values.astype(np.int64), {1: "body"}, (("field", field),), ())


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("strain", "noise_mm", "seed"), [(0.1, 0.12, 1), (0.06, 0.12, 2), (0.03, 0.04, 3)])
def test_noise_strains_a_cube_by_half_of_what_the_load_does(strain: float, noise_mm: float, seed: int, *, stated: bool) -> None:
    """The slope of a regression on n points that are spread evenly along h has the variance 12 s^2 / (n h^2)."""
    cubes, told = cubes_of_map(scanned(strain, noise_mm, 2500, stated=stated, seed=seed), 2500)
    edge = (SIZE_MM**3 / cubes.mesh.n_cells) ** (1.0 / 3.0)
    in_cube = 2500 / cubes.mesh.n_cells
    ratio = float(np.sqrt(12.0 / in_cube)) * noise_mm / edge / strain
    assert len(told) == 1 and f"The map has {cubes.mesh.n_cells} elements" in told[0]
    assert ratio == pytest.approx(NOISE_OF_STRAIN, rel=0.15)  # whole numbers of cubes, and noise that is found to a few per cent


def test_precise_fields_have_as_many_cubes_as_before_and_none_fewer_than_a_few() -> None:
    usual, told = cubes_of_map(scanned(0.1, 0.004, 900), 900)
    assert not told and usual.mesh.n_cells >= LEAST_OF_MAP
    few, told = cubes_of_map(scanned(0.1, 0.004, 300), 300)
    assert not told and few.mesh.n_cells == 729
    fewest, told = cubes_of_map(scanned(0.02, 0.4, 900), 900)
    assert told and 0.8 * FEWEST < fewest.mesh.n_cells < 2 * FEWEST


def test_noise_that_is_not_stated_is_found_whatever_the_size_of_cubes() -> None:
    """Of fewer points than cubes, a thousandth of the largest displacement was called their scatter, ten times too little."""
    noisy = scanned(0.1, 0.12, 900, stated=False, seed=4)
    for cells in (200, 1000, 2000):
        (case,) = noisy.on_cubes(noisy.edge_mm(cells), (), exactly=True, each_cell=False).load_cases
        assert noise_mm(case) == pytest.approx(0.12, rel=0.1)


def test_a_map_of_a_noisy_field_is_right_or_says_that_it_cannot_tell(tmp_path: Path) -> None:
    """With noise of 3 % of the largest displacement and more, searches at finite strain advanced so little that a map took hours."""
    rng = np.random.default_rng(7)
    points, u = QuadraticBody("cube").solved((0.0, 0.0, -4.0), divisions=4).at(rng.uniform(0.0, 1.0, (700, 3)))
    u = u + 0.24 * rng.standard_normal(u.shape)
    write_field(tmp_path / "field.h5", DisplacementField.from_arrays(points, u, sd_mm=0.24))
    labels = np.ones((20, 20, 20), dtype=np.uint8)
    write_volume(tmp_path / "mask.mha", Volume.from_array(labels, spacing_mm=(2.0,) * 3, origin_mm=(1.0,) * 3))
    run = identify_fields(tmp_path / "field.h5", mask=tmp_path / "mask.mha", each_cell=True)
    assert run.estimate.mesh.n_cells < 700 and any("noise of 0.24 mm would strain" in note for note in run.notes)
    assert run.estimate.uncertainty is not None
    below, above = run.estimate.zones.of_cell[[0, -1]]
    if below != above:  # the upper half is twice as stiff
        intervals = run.estimate.intervals()[0]
        low, high = intervals[above] / run.estimate.young_modulus[below]
        assert low < 2.0 < high or intervals[below][0] / run.estimate.young_modulus[above] < 0.5
