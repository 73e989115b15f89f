"""Studies whose elements come from moduli: by label, by voxel, in the frame of a scan; pressed, against the closed form of a bar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lattice_studies import study_file

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import read_volume, write_volume
from naibu.mechanics.lattices.model.elastic_springs import elastic_stiffness
from naibu.workflows.studies.calibration.calibrate import calibrate_study
from naibu.workflows.studies.lattice_study import prepared_study

STUDY = """
[object]
labels = "labels.mha"
density_g_per_cm3 = 1.0
[lattice]
spacing_mm = 6.0
[material]
young_modulus_kPa = {modulus}
retardation_s = 0.05
relaxation_s = 2.0
[simulation]
duration_s = 0.1
[floor]
"""
DIRECTION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def scanned(tmp_path: Path) -> np.ndarray:
    """Two zones of cubes of 6 mm in voxels of 2 mm, and the modulus of each cube in the order of the lattice."""
    cubes = np.array([1, 1, 2, 2]).reshape(2, 1, 2).repeat(2, axis=1)  # x, y, z
    fine = np.pad(cubes.repeat(3, 0).repeat(3, 1).repeat(3, 2), 2).astype(np.uint8)
    grid = {"spacing_mm": (2.0, 2.0, 2.0), "origin_mm": (5.0, -3.0, 20.0), "direction": DIRECTION}
    write_volume(tmp_path / "labels.mha", Volume.from_array(fine.T, **grid))
    moduli = np.array([0.0, 12.0, 40.0])[fine]
    write_volume(tmp_path / "young_modulus.mha", Volume.from_array(moduli.T, **grid))
    return np.array([0.0, 12.0, 40.0])[cubes].ravel()


@pytest.mark.parametrize("modulus", ["{ 1 = 12.0, 2 = 40 }", '"young_modulus.mha"'])
def test_moduli_of_zones_and_of_voxels_make_the_elements(tmp_path: Path, scanned: np.ndarray, modulus: str) -> None:
    study = prepared_study(study_file(tmp_path, STUDY.format(modulus=modulus)))
    expected = elastic_stiffness(study.study.lattice, scanned)
    np.testing.assert_allclose(study.study.parameters.stiffness, expected, rtol=1e-12)
    np.testing.assert_allclose(study.study.parameters.voigt_damping, 0.05 * expected, rtol=1e-12)
    np.testing.assert_allclose(study.study.parameters.series_damping, 2.0 * expected, rtol=1e-12)
    assert ("young_modulus.mha" in study.inputs) == ("mha" in modulus)


def test_a_bar_that_slides_is_as_stiff_as_its_modulus_says(tmp_path: Path) -> None:
    """Pressed by 1 % between plates without friction, sigma = E strain."""
    text = """
[object]
size_mm = [20, 20, 40]
density_g_per_cm3 = 1.0
[lattice]
spacing_mm = 10.0
[material]
young_modulus_kPa = 30
[simulation]
duration_s = 1.5
[floor]
contact = "friction"
[[indenter]]
name = "plate"
shape = "box"
size_mm = [40, 40, 10]
centre_mm = [10, 10, 45]
path = [[0.0, 0, 0, 0], [1.0, 0, 0, -0.4]]
"""
    from naibu.mechanics.lattices.simulation.loading_history import run_study

    study = prepared_study(
        study_file(tmp_path, text.replace("young_modulus_kPa = 30", "young_modulus_kPa = 30\nretardation_s = 0.02"))
    ).study
    *_, last = run_study(study)
    assert -last.force[-1, 1, 2] == pytest.approx(30.0 * 0.01 * 400.0, rel=0.02)


@pytest.mark.parametrize(
    ("modulus", "more", "words"),
    [
        ("{ 1 = 12.0 }", "", ("no modulus of label 2", "labels.mha")),
        ("{ gel = 12.0 }", "", ("'gel' is no label",)),
        ("-3.0", "", ("must lie between",)),
        ('"elsewhere.mha"', "", ("elsewhere.mha",)),
        ("12.0", "[parameters]\nK = 1.0\nC1 = 1.0\nC2 = 1.0\n", ("[material]", "one of the two")),
    ],
)
def test_moduli_that_cannot_be_are_told(tmp_path: Path, scanned: np.ndarray, modulus: str, more: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as told:
        prepared_study(study_file(tmp_path, STUDY.format(modulus=modulus) + more))
    assert all(word in str(told.value) for word in words)


def test_a_map_that_does_not_cover_the_object_is_refused(tmp_path: Path, scanned: np.ndarray) -> None:
    small = Volume.from_array(np.full((4, 4, 4), 9.0), spacing_mm=(2.0, 2.0, 2.0), origin_mm=(500.0, 0.0, 0.0))
    write_volume(tmp_path / "young_modulus.mha", small)
    with pytest.raises(InputError, match="8 of 8 cubes of the object no positive modulus"):
        prepared_study(study_file(tmp_path, STUDY.format(modulus='"young_modulus.mha"')))


def test_a_map_that_leaves_a_modulus_open_gives_no_lattice(tmp_path: Path, scanned: np.ndarray) -> None:
    there = read_volume(tmp_path / "young_modulus.mha")
    write_volume(tmp_path / "young_modulus.mha", there.with_values(np.full(there.shape, np.nan)))
    with pytest.raises(InputError, match="8 of 8 cubes of the object no positive modulus"):
        prepared_study(study_file(tmp_path, STUDY.format(modulus='"young_modulus.mha"')))


def test_elements_from_moduli_are_not_calibrated_by_class(tmp_path: Path, scanned: np.ndarray) -> None:
    path = study_file(tmp_path, STUDY.format(modulus="12.0"))
    cloud = tmp_path / "cloud.csv"
    cloud.write_text("time_s,x_mm,y_mm,z_mm\n0,0,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"come from \[material\]"):
        calibrate_study(path, shapes=[cloud], out=tmp_path / "out")
