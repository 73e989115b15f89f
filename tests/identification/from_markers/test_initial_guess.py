"""Force balance: exact where the mesh is the truth's own, biased where nodes are interpolated or noisy, and honest about what it lacks."""

from dataclasses import replace

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading
from naibu.core.mesh import Mesh
from naibu.identification.from_markers.initial_guess import equilibrium_gap, equilibrium_gap_of_meshes
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.marker_mesh import MarkerMesh, marker_mesh
from naibu.identification.from_markers.specimen.parameter_names import poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box_from_coordinates
from naibu.validation.specimens.marker_phantoms import Scanner, VirtualSpecimen, box_experiment, virtual_specimen

KNOWN = KnownMaterials({"hard": 222.0})
NOTHING = Scanner(0.0, 0.0, 0.0, missing=0.0)
SOFT = (120.0, 0.47)


def solved(sign: float = 1.0) -> MarkerMesh:
    """A two-layer box whose surface is pressed and sheared; the inside is in equilibrium."""
    x = np.linspace(-20.0, 20.0, 5)
    mesh = box_from_coordinates(x, x, x + 20.0, region_of_slab=["soft", "soft", "hard", "hard"])
    law = [material(young_modulus=e, poisson_ratio=nu) for e, nu in (SOFT, (222.0, 0.4))]
    order = [("soft", "hard").index(name) for name in mesh.region_names]
    assembler = Assembler.from_materials(elements(mesh), mesh.regions, [law[i] for i in order])
    p = mesh.points
    on_surface = (np.abs(p[:, 0]) > 19.9) | (np.abs(p[:, 1]) > 19.9) | (p[:, 2] < 0.1) | (p[:, 2] > 39.9)
    pressed = np.stack([0.1 * p[:, 0] + sign * 2e-3 * p[:, 1] * p[:, 2], 0.05 * p[:, 1], -0.2 * p[:, 2] + 2e-3 * p[:, 0] ** 2], axis=1)
    constrained = PrescribedDisplacement.none(mesh.n_points).and_also(np.flatnonzero(on_surface), pressed[on_surface])
    u = solve(Problem(p, assembler, (), constrained, np.zeros_like(p))).displacement
    return MarkerMesh("box/pressed", mesh, u, np.ones(u.shape, dtype=bool), np.flatnonzero(~on_surface))


@pytest.mark.parametrize("sweeps", [0, 2])
def test_parameters_come_back_from_a_solution_on_the_same_mesh(sweeps: int) -> None:
    found = equilibrium_gap_of_meshes(
        [solved(), solved(-1.0)], [np.full(3, 0.1)] * 2, {"hard": 222.0}, poisson_ratios={"hard": 0.4}, sweeps=sweeps
    )
    np.testing.assert_allclose(found["soft"], SOFT, rtol=1e-6)


def test_the_poisson_ratio_of_the_known_material_is_found_too() -> None:
    found = equilibrium_gap_of_meshes([solved(), solved(-1.0)], [np.full(3, 0.1)] * 2, {"hard": 222.0}, sweeps=30)
    np.testing.assert_allclose(found["soft"], SOFT, rtol=1e-6)


def twin(heights: tuple[float, ...]) -> VirtualSpecimen:
    e = box_experiment("twin", (60.0, 60.0, 60.0), [("soft", 30.0), ("hard", 30.0)], Loading("plate"), {"pressed": 46.0})
    truth = {young_modulus("soft"): SOFT[0], poisson_ratio("soft"): SOFT[1], young_modulus("hard"): 222.0, poisson_ratio("hard"): 0.47}
    return virtual_specimen(replace(e, nominal_heights_mm=heights), truth, settings=ModelSettings(element_size_mm=60.0 / 9.0))


@pytest.fixture(scope="module")
def aligned() -> VirtualSpecimen:
    return twin((10.0, 20.0, 30.0, 40.0, 50.0))


@pytest.fixture(scope="module")
def between() -> VirtualSpecimen:
    return twin((10.0, 20.0, 40.0, 50.0))


def estimate(body: VirtualSpecimen, scanner: Scanner | None = None, seed: int = 1, sweeps: int = 2) -> tuple[float, float]:
    return equilibrium_gap([body.scanned(seed=seed, scanner=scanner).experiment], KNOWN, sweeps=sweeps)["soft"]


def test_markers_on_the_interface_without_noise_leave_the_error_of_a_coarse_mesh(aligned: VirtualSpecimen) -> None:
    e, nu = estimate(aligned, NOTHING)
    assert e == pytest.approx(SOFT[0], rel=0.1)
    assert nu == pytest.approx(SOFT[1], abs=0.05)


def test_an_interface_between_layers_pulls_the_modulus_towards_the_known_one(between: VirtualSpecimen) -> None:
    e, _ = estimate(between, NOTHING)
    assert 1.2 * SOFT[0] < e < 222.0


def test_noise_pulls_poissons_ratio_down_and_sweeps_bring_some_of_it_back(between: VirtualSpecimen) -> None:
    plain = np.array([estimate(between, seed=s, sweeps=0) for s in range(3)])
    swept = np.array([estimate(between, seed=s) for s in range(3)])
    assert plain[:, 1].max() < 0.1
    assert (swept[:, 1] > 0.2).all() and (swept[:, 1] < SOFT[1]).all()
    assert (swept[:, 0] > 0.5 * SOFT[0]).all() and (swept[:, 0] < 2.5 * SOFT[0]).all()


def test_an_interface_between_layers_gets_nodes_and_cells_get_the_material_at_their_middle() -> None:
    mesh = marker_mesh(datasets.load("ct_two_material_3"), "deformed")
    z = mesh.mesh.points[:, 2].reshape(6, 25)
    np.testing.assert_allclose(z[[1, 3]], [[15.0] * 25, [30.0] * 25])
    assert not mesh.measured.reshape(6, 25, 3)[[1, 3]].any()
    names = np.array(mesh.mesh.region_names)[mesh.mesh.regions].reshape(4, 4, 5)[0, 0]
    assert names.tolist() == ["hardness 5", "hardness 0", "hardness 0", "hardness 5", "hardness 5"]
    assert elements(mesh.mesh).volume == pytest.approx(40.0**3, rel=0.02)
    assert len(mesh.interior) == 3 * 3 * 4


def test_rigid_motion_of_the_scan_does_not_count() -> None:
    e = datasets.load("ct_two_material_2")
    mesh = marker_mesh(e, "deformed")
    assert np.abs(mesh.displacement.mean(axis=0)).max() < 1.0
    assert isinstance(mesh.mesh, Mesh)


def test_bundled_cubes_give_a_start_of_the_right_size() -> None:
    experiments = [datasets.load(f"ct_two_material_{k}") for k in (2, 3)]
    e, nu = equilibrium_gap(experiments, KnownMaterials({"hardness 5": 222.0}))["hardness 0"]
    assert 60.0 < e < 222.0
    assert 0.0 < nu < 0.5


def lone(experiment: Experiment) -> Experiment:
    return replace(experiment, layers=(replace(experiment.layers[0], material="other", to_base_mm=60.0),))


@pytest.mark.parametrize(
    ("experiments", "known", "words"),
    [
        ([], {"hardness 5": 222.0}, "no loaded state"),
        ([datasets.load("ct_half_ellipsoid")], {"hardness 5": 222.0}, "not numbered on a lattice"),
        ([datasets.load("us_agar")], {"hardness 5": 222.0}, "three-dimensional"),
        ([datasets.load("ct_two_material_2")], {}, "name a material"),
        ([datasets.load("ct_two_material_2")], {"hardness 5": 222.0, "hardness 0": 125.0}, "no material is unknown"),
        ([datasets.load("ct_two_material_2"), lone(datasets.load("ct_two_material_2"))], {"hardness 5": 222.0}, "touches other"),
    ],
)  # fmt: skip
def test_what_cannot_be_balanced_is_said(experiments: list[Experiment], known: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        equilibrium_gap(experiments, KnownMaterials(known))


def test_a_state_that_holds_no_positions_is_named() -> None:
    with pytest.raises(InputError, match=r"ct_two_material_4/deformed has no measured positions"):
        marker_mesh(datasets.load("ct_two_material_4"), "deformed")
