"""The file of a lattice study: what it makes, and how every kind of mistake in it is told."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lattice_studies import STUDY, study_file

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.io.study_schemas.lattice_study_schema import load_study
from naibu.mechanics.lattices.model.hexahedra import lattice_mesh
from naibu.mechanics.lattices.model.lattice import classic_lattice
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.mechanics.lattices.model.voxels import voxel_mask
from naibu.validation.specimens.lattice_twin import CUBE_PUSHING, FIRST, SECOND, dough_lattice, dough_parameters
from naibu.workflows.studies.lattice_study import BASES, NAMED, class_ratios, prepared_study, study_text


@pytest.mark.parametrize("name", [*BASES, "cube-pushing-octree-1"])
def test_the_studies_that_come_along_are_valid(name: str) -> None:
    prepared = prepared_study(name)
    assert prepared.study.frames > 10 and prepared.name == name
    mass = {"dough": 0.51, "cube-": 0.63}[name[:5]]
    assert prepared.study.lattice.total_mass == pytest.approx(mass)
    assert prepared.settings.lattice.kind == ("octree-" + name[-1] if "octree" in name else "classic")


@pytest.mark.parametrize(
    ("name", "pushing"), [("dough-first-pushing", FIRST), ("dough-second-pushing", SECOND), ("cube-pushing", CUBE_PUSHING)]
)
def test_the_report_s_pushings_are_those_of_the_twin(name: str, pushing: object) -> None:
    from naibu.mechanics.lattices.simulation.tied_bodies import tied_nodes

    study = prepared_study(name).study
    floor, *constrained = tied_nodes(study.lattice, study.bodies)
    for mine, theirs, body, face in zip(constrained, pushing.touched(study.lattice), study.bodies[1:], pushing.faces, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        np.testing.assert_allclose(body.moved(np.array([pushing.push_s])), pushing.push_s * np.array([face.velocity]))
        np.testing.assert_allclose(body.moved(np.array([pushing.contact_s])), body.moved(np.array([pushing.push_s])))
        assert body.tied_until_s == pytest.approx(pushing.contact_s)
    assert (study.lattice.points[floor, 2] == 0.0).all()
    if name.startswith("dough"):
        twin = dough_lattice()
        np.testing.assert_array_equal(study.lattice.node_mass, twin.node_mass)
        for attribute in ("stiffness", "voigt_damping", "series_damping"):
            np.testing.assert_allclose(getattr(study.parameters, attribute), getattr(dough_parameters(twin), attribute))


def test_every_variant_differs_in_the_lattice_only() -> None:
    for name in NAMED:
        base = next(b for b in BASES if name.startswith(b))
        found, plain = (load_study(each, study_text(each).encode()) for each in (name, base))
        assert found.lattice.kind == ("classic" if name == base else name.removeprefix(f"{base}-"))
        assert found.model_dump(exclude={"title", "lattice"}) == plain.model_dump(exclude={"title", "lattice"})
        assert (found.title == plain.title) == (name == base)


def test_the_template_says_what_may_be_written() -> None:
    text = study_text("dough-pressed-by-sphere")
    for key in ("labels", "density_g_per_cm3", "octree-0", "velocity", "force =", "until_s", "euler", "gravity_mm_per_s2", "inf"):
        assert key in text
    with pytest.raises(InputError, match="cube-pushing-octree-2"):
        study_text("cube")


@pytest.mark.parametrize("kind", ["classic", 0, 1, 2])
def test_the_hexahedra_fill_the_object(kind: str | int) -> None:
    mask = np.ones((5, 6, 5), dtype=bool)
    mask[:2, 5:, 4:] = False
    lattice = classic_lattice(mask, 2.0, density=1e-6) if kind == "classic" else octree_lattice(mask, 2.0, int(kind), density=1e-6)
    mesh = lattice_mesh(lattice)
    x = mesh.points[mesh.cells]
    edges = np.stack([x[:, 1] - x[:, 0], x[:, 3] - x[:, 0], x[:, 4] - x[:, 0]], axis=1)
    assert np.linalg.det(edges).sum() == pytest.approx(8.0 * mask.sum())  # positive: VTK's order
    assert (np.linalg.det(edges) > 0.0).all()
    np.testing.assert_allclose(x[:, 6], x[:, 0] + edges.sum(axis=1))
    assert set(np.unique(surface_of(lattice).triangles)) <= set(np.unique(mesh.cells))


@given(
    cells=st.tuples(*[st.integers(1, 4)] * 3),
    voxels=st.tuples(*[st.integers(1, 4)] * 3),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_voxels_that_divide_the_spacing_give_their_cubes(cells: tuple[int, int, int], voxels: tuple[int, int, int], seed: int) -> None:
    """A mask of cubes, cut into finer voxels of any shape, is found again, less the empty layers around it."""
    mask = np.random.default_rng(seed).random(cells) < 0.6
    mask[0, 0, 0] = mask[-1, -1, -1] = True
    fine = mask.repeat(voxels[0], 0).repeat(voxels[1], 1).repeat(voxels[2], 2)
    volume = Volume.from_array(fine.T, spacing_mm=6.0 / np.array(voxels), origin_mm=(1.0, 2.0, 3.0))
    found, frame = voxel_mask(volume, fine.T, 6.0)
    np.testing.assert_array_equal(found, mask)
    np.testing.assert_allclose(frame.translation, volume.to_physical([-0.5, -0.5, -0.5]))


@pytest.mark.parametrize("ending", [".nrrd", ".mha", ".npy"])
def test_an_object_of_labels(tmp_path: Path, ending: str) -> None:
    labels = np.zeros((12, 10, 8), dtype=np.uint8)  # x, y, z
    labels[2:8, 2:8, 2:6] = 3
    labels[2:8, 2:8, 6:8] = 4
    if ending == ".npy":
        np.save(tmp_path / "scan.npy", labels)
    else:
        write_volume(tmp_path / f"scan{ending}", Volume.from_array(labels.T, spacing_mm=(5.0, 5.0, 5.0)))
    text = STUDY.replace(
        "size_mm = [30, 20, 20]", f'labels = "scan{ending}"\nlabel = 3' + ("\nvoxel_mm = [5, 5, 5]" if ending == ".npy" else "")
    )
    prepared = prepared_study(study_file(tmp_path, text))
    np.testing.assert_allclose(np.ptp(prepared.study.lattice.points, axis=0), [30.0, 30.0, 20.0])
    assert prepared.study.lattice.points.min() == 0.0 and prepared.study.lattice.total_mass == pytest.approx(0.012)
    assert set(prepared.inputs) == {"mine.toml", f"scan{ending}"} and all(len(digest) == 64 for digest in prepared.inputs.values())


def test_labels_that_are_no_array_or_lie_elsewhere_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    np.save(tmp_path / "scan.npy", np.ones((4, 4, 4), dtype=np.uint8))
    whole = (tmp_path / "scan.npy").read_bytes()
    (folder / "cut.npy").write_bytes(whole[:-9])
    (folder / "huge.npy").write_bytes(whole.replace(b"(4, 4, 4), ", b"(9999999999, 4, 4), ")[: len(whole)])
    os.mkfifo(folder / "pipe.npy")
    for labels, words in (
        ("../scan.npy", "outside the folder"),
        (str(tmp_path / "scan.npy"), "outside the folder"),
        ("cut.npy", "save the labels by numpy.save"),
        ("huge.npy", "save the labels by numpy.save"),
        ("pipe.npy", "device or a pipe"),
    ):
        text = STUDY.replace("size_mm = [30, 20, 20]", f'labels = "{labels}"\nvoxel_mm = [5, 5, 5]')
        with pytest.raises(InputError, match=words):
            prepared_study(study_file(folder, text))


def test_the_density_makes_the_mass(tmp_path: Path) -> None:
    study = prepared_study(study_file(tmp_path, STUDY.replace("mass_g = 12.0", "density_g_per_cm3 = 1.25"))).study
    assert study.lattice.total_mass == pytest.approx(1.25e-3 * 3 * 2 * 2)  # 12 cm^3


def test_forces_and_velocities_move_indenters(tmp_path: Path) -> None:
    by_velocity = STUDY.replace("path = [[0.0, 0, 0, 0], [0.1, 0, 0, -3]]", "velocity = [[0.05, 0, 0, -30], [0.1, 1, 0, 0]]")
    body = prepared_study(study_file(tmp_path, by_velocity)).study.bodies[1]
    np.testing.assert_allclose(
        body.moved(np.array([0.0, 0.05, 0.1, 0.2])), [[0, 0, 0], [0, 0, 0], [0, 0, -1.5], [0.1, 0, -1.5]], atol=1e-12
    )
    by_force = STUDY.replace(
        "path = [[0.0, 0, 0, 0], [0.1, 0, 0, -3]]", "force = [[0.0, 0.0], [0.1, 50]]\ndirection = [0, 0, -1]\nmass_g = 20"
    )
    drive = prepared_study(study_file(tmp_path, by_force)).study.bodies[1].drive
    assert drive is not None and drive.mass_kg == pytest.approx(0.02) and drive.force.tolist() == [0.0, 50.0]


@pytest.mark.parametrize(
    ("change", "to", "words"),
    [
        ("duration_s = 0.2", "duration_s = 0.2\nsteps = 3", ("[simulation] steps = 3", "not a known key", "step_s")),
        ("mass_g = 12.0", "mass_kg = 0.012", ("[object] mass_kg = 0.012", "unit of 'mass_g'")),
        ("size_mm = [30, 20, 20]", "size_cm = [3, 2, 2]", ("[object] size_cm", "unit of 'size_mm'")),
        ("mass_g = 12.0", "density_g_per_cm3 = 1000.0", ("density_g_per_cm3 = 1000", "unit is g/cm^3")),
        ("mass_g = 12.0", "mass_g = -12.0", ("[object] mass_g = -12.0", "greater than 0")),
        ("mass_g = 12.0", "", ("[object]", "mass_g or density_g_per_cm3")),
        ("K = 40.0", "K = -1.0", ("[parameters] K = -1.0", "not negative")),
        ("K = 40.0", 'K = "soft"', ("[parameters] K = 'soft'", "number, or a table")),
        ("K = 40.0", "K = {short = 1.0, middle = 2.0}", ("'middle'", "short, normal, long")),
        ("K = 40.0", "K = {short = 1.0, normal = 2.0}", ("[parameters] K", "long")),
        ("C2 = 100.0", "C2 = 0.0", ("[parameters] C2 = 0.0", "inf")),
        ("C2 = 100.0", "", ("[parameters] C2 is missing", "mN s/mm")),
        ("[parameters]\nK = 40.0\nC1 = 10.0\nC2 = 100.0", "", ("[parameters] is missing", "add a table")),
        ("spacing_mm = 10.0", "spacing_mm = 7.0", ("size_mm = [30.0, 20.0, 20.0]", "spacing_mm = 7", "divides")),
        ("duration_s = 0.2", "duration_s = 0.21", ("duration_s = 0.21", "every_s = 0.02")),
        ("duration_s = 0.2", 'duration_s = 0.2\nmethod = "euler"', ('method = "euler"', "implicit")),
        ("every_s = 0.02", "every_s = 0.02\nforces_every_s = 0.003", ("forces_every_s = 0.003", "step_s")),
        ("every_s = 0.02", 'every_s = 0.02\nquantities = ["speed"]', ("[output] quantities, entry 1 = 'speed'", "velocity")),
        ("centre_mm = [10.0, 10.0, 28.5]", "centre_mm = [10.0, 10.0, 25.0]", ("number 1 centre_mm", "25.0]", "inside", "move it back")),
        ("radius_mm = 8.0", "size_mm = [1, 1, 1]", ("[[indenter]] number 1 a sphere has radius_mm", "add radius_mm")),
        ("[0.1, 0, 0, -3]", "[0.1, 0, -3]", ("[[indenter]] number 1 path", "row 2 has 3 numbers", "[time in s")),
        ("[0.1, 0, 0, -3]", "[0.0, 0, 0, -3]", ("[[indenter]] number 1 path", "must grow")),
        ("[[0.0, 0, 0, 0]", "[[0.0, 1, 0, 0]", ("must begin with 0, 0, 0", "centre_mm")),
        ("path =", "force = [[0.0, 1.0]]\npath =", ("path and force", "one of them")),
        ('contact = "friction"', 'contact = "sticking"', ("[floor]", "static_friction")),
        ("static_friction = 0.5", "static_friction = 0.5\nkinetic_friction = 0.7", ("kinetic_friction = 0.7 exceeds", "0.5")),
        ('name = "ball"', 'name = "floor"', ("name = 'floor'", "twice")),
        ('shape = "sphere"', 'shape = "cone"', ("[[indenter]] number 1 shape = 'cone'", "cylinder")),
        ("[floor]", "[flor]", ("flor is not a known key", "'floor'")),
        ("[lattice]", "[lattice", ("line 5", "not valid TOML")),
    ],
)  # fmt: skip
def test_every_mistake_is_told_with_file_field_value_and_mend(tmp_path: Path, change: str, to: str, words: tuple[str, ...]) -> None:
    assert change in STUDY
    path = study_file(tmp_path, STUDY.replace(change, to))
    with pytest.raises(InputError) as refused:
        prepared_study(path)
    for word in (str(path), *words):
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("labels", "more", "words"),
    [
        (np.zeros((4, 4, 4)), "", ("labels other than 0", "its labels are 0")),
        (np.ones((4, 4, 4)), "label = [2, 5]", ("label = [2, 5]", "its labels are 1")),
        (np.eye(6)[:, :, None].repeat(6, 2)[:, ::3], "", ("falls into 2 pieces", "largest_piece = true")),
        (np.ones((4, 4)), "", ("three axes",)),
        (None, "", ("no such file",)),
    ],
)
def test_masks_that_cannot_be_used_are_told(tmp_path: Path, labels: np.ndarray | None, more: str, words: tuple[str, ...]) -> None:
    if labels is not None:
        np.save(tmp_path / "scan.npy", labels)
    text = STUDY.replace("size_mm = [30, 20, 20]", f'labels = "scan.npy"\nvoxel_mm = [10, 10, 10]\n{more}')
    path = study_file(tmp_path, text)
    with pytest.raises(InputError) as refused:
        prepared_study(path)
    for word in (str(path), "[object]", *words):
        assert word.lower() in str(refused.value).lower()


def test_the_largest_piece_can_be_kept(tmp_path: Path) -> None:
    labels = np.zeros((6, 2, 2), dtype=np.int16)
    labels[0], labels[3:] = 1, 1
    np.save(tmp_path / "scan.npy", labels)
    text = STUDY.replace("size_mm = [30, 20, 20]", 'labels = "scan.npy"\nvoxel_mm = [10, 10, 10]\nlargest_piece = true')
    assert len(prepared_study(study_file(tmp_path, text)).mesh.cells) == 12


def test_settings_change_the_fingerprint_and_comments_do_not(tmp_path: Path) -> None:
    first = prepared_study(study_file(tmp_path)).fingerprint
    assert prepared_study(study_file(tmp_path, "# a comment\n" + STUDY)).fingerprint == first
    assert prepared_study(study_file(tmp_path, STUDY.replace("K = 40.0", "K = 40.1"))).fingerprint != first


@pytest.mark.parametrize(
    ("stiffness", "ratios"),
    [
        (40.0, (1.0, 1.0, 1.0)),
        ({"short": 60.0, "normal": 40.0, "long": 20.0}, (60.0, 40.0, 20.0)),
        ({"core": {"short": 6.0, "normal": 4.0, "long": 2.0}, "surface": 9.0}, (6.0, 4.0, 2.0)),
        ({"core": 6.0, "surface": 9.0}, (1.0, 1.0, 1.0)),
        ({"short": {"core": 6.0, "surface": 7.0}, "normal": 4.0, "long": 2.0}, (6.0, 4.0, 2.0)),
        ({"short": 60.0, "normal": 40.0, "long": 0.0}, (1.0, 1.0, 1.0)),
    ],
)
def test_octrees_are_told_how_classes_differ(stiffness, ratios) -> None:
    assert class_ratios(stiffness) == ratios
