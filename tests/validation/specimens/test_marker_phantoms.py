"""Virtual specimens: lattices come back from their scans, noise is as asked, gels keep their volume, seeds repeat."""

import io
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.specimen.parameter_names import friction, platen_position, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.scan_alignment import placement
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.statics import solve
from naibu.validation.analytic.finite_strain import uniaxial
from naibu.validation.specimens.marker_phantoms import Scanner, VirtualSpecimen, box_experiment, marker_lattice, phantom, virtual_specimen

SIZE = (40.0, 40.0, 40.0)
COARSE = ModelSettings(element_size_mm=40 / 7)
EXACT = Scanner(placing_mm=0.0, xy_step_mm=0.0, z_step_mm=0.0)


def plate(*layers: tuple[str, float], states=None) -> Experiment:
    return box_experiment("twin", SIZE, layers or [("gel", 40.0)], Loading("plate"), states or {"pressed": 30.0})


def truth_of(**moduli: tuple[float, float]) -> dict[str, float]:
    out = {}
    for name, (young, nu) in moduli.items():
        out |= {young_modulus(name): young, poisson_ratio(name): nu}
    return out


def rubbing(mu: float, *materials: str) -> dict[str, float]:
    return {friction(m, body): mu for m in materials for body in ("table", "acrylic")}


@pytest.fixture(scope="module")
def gel() -> VirtualSpecimen:
    truth = truth_of(gel=(20.0, 0.48)) | rubbing(0.4, "gel")
    return virtual_specimen(plate(states={"pressed": 34.0, "more": 30.0}), truth, settings=COARSE)


def test_lattice_is_where_it_is_nominal():
    places = marker_lattice(plate())
    assert len(places) == 27
    assert places[:3].tolist() == [[-10, -10, 10], [0, -10, 10], [10, -10, 10]]
    np.testing.assert_allclose(places.mean(axis=0), [0, 0, 20])
    bundled = datasets.load("ct_two_material_1")
    assert sorted(set(marker_lattice(bundled)[:, 2])) == [10, 20, 40, 50]
    assert len(marker_lattice(bundled)) == len(bundled.initial)


def test_exact_scans_give_the_lattice_back(gel):
    seen = gel.scanned(seed=1, scanner=EXACT)
    experiment = seen.experiment
    place = placement(experiment)
    np.testing.assert_allclose(place.to_object(experiment.initial.points), marker_lattice(plate()), atol=1e-9)
    for name, exact in gel.loaded.items():
        points = experiment.state(name).markers.points
        found = registration(exact, points)
        np.testing.assert_allclose(found.rotation, seen.poses[name].rotation, atol=1e-9)
        np.testing.assert_allclose(found.applied(exact), points, atol=1e-9)
        assert np.abs(points - exact).max() > 1  # each scan has a pose of its own


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_scans_keep_distances_between_markers(gel, seed):
    experiment = gel.scanned(seed=seed, scanner=EXACT).experiment
    for name, exact in {"initial": gel.free, **gel.loaded}.items():
        points = experiment.state(name).markers.points
        distances = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (points, exact)]
        np.testing.assert_allclose(*distances, atol=1e-9)


@pytest.mark.parametrize(
    "scanner", [Scanner(0.2, 0, 0), Scanner(0, 0.6, 0.9), Scanner(0.15, 0.3, 0.8)], ids=["placing", "rounding", "both"]
)
def test_noise_is_as_asked(gel, scanner):
    errors = []
    for seed in range(60):
        seen = gel.scanned(seed=seed, scanner=scanner)
        for name, exact in {"initial": gel.free, **gel.loaded}.items():
            errors.append(seen.experiment.state(name).markers.points - seen.poses[name].applied(exact))
    errors = np.concatenate(errors)  # 60 scans of 3 states of 27 markers: a standard deviation is known within 1 %
    np.testing.assert_allclose(errors.std(axis=0), scanner.standard_deviation, rtol=0.05)
    assert np.abs(errors.mean(axis=0)).max() < 5 * scanner.standard_deviation.max() / np.sqrt(len(errors))
    by_hand = np.hypot(scanner.placing_mm, np.array([scanner.xy_step_mm, scanner.xy_step_mm, scanner.z_step_mm]) / np.sqrt(12))
    np.testing.assert_allclose(scanner.standard_deviation, by_hand)


def test_a_phantom_is_an_experiment_that_can_be_identified(gel):
    experiment = gel.scanned(seed=2, scanner=Scanner(missing=0.02)).experiment
    model = specimen(experiment, ModelSettings(element_size_mm=5.0))
    assert len(model.marker_ids) == 27
    error = model.marker_points - marker_lattice(plate())
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.35
    state = solve(model.problem(gel.truth, "pressed")).displacement
    predicted = model.marker_points + model.at_markers(state)
    measured = experiment.state("pressed").markers.aligned(model.marker_ids)
    misfit = measured - registration(predicted, measured).applied(predicted)
    noise = np.sqrt(2) * Scanner().standard_deviation  # of two scans
    assert 0.7 < np.sqrt(np.nanmean((misfit / noise) ** 2)) < 1.4


def test_coordinates_are_rounded_to_pixels_and_slices(gel):
    scanner = Scanner(xy_step_mm=0.25, z_step_mm=0.5)
    experiment = gel.scanned(seed=0, scanner=scanner).experiment
    steps = np.array([0.25, 0.25, 0.5])
    ratio = experiment.initial.points / steps
    np.testing.assert_allclose(ratio, np.round(ratio), atol=1e-9)
    assert (experiment.xy_step_mm, experiment.z_step_mm) == (0.25, 0.5)


def test_coordinates_get_lost_at_the_rate_asked_for(gel):
    lost = [~np.isfinite(gel.scanned(seed=s, scanner=Scanner(missing=0.2)).experiment.initial.points) for s in range(60)]
    assert np.mean(lost) == pytest.approx(0.2, abs=0.03)


def test_the_same_seed_gives_the_same_scan(gel):
    one, two, other = (gel.scanned(seed=s).experiment for s in (3, 3, 4))
    for name in ("initial", "pressed", "more"):
        assert np.array_equal(one.state(name).markers.points, two.state(name).markers.points)
        assert np.abs(one.state(name).markers.points - other.state(name).markers.points).max() > 1


def test_a_scan_goes_to_other_processes(gel):
    seen = gel.scanned(seed=3).experiment
    sent = io.BytesIO()
    pickler = pickle.Pickler(sent)
    pickler.dispatch_table = {}  # without what packages that happen to be loaded taught it
    pickler.dump(seen)
    got = pickle.loads(sent.getvalue())
    assert got.name == seen.name and got.title == seen.title
    np.testing.assert_array_equal(got.states[1].markers.points, seen.states[1].markers.points)


def test_the_same_seed_gives_the_same_phantom():
    template, truth = plate(), truth_of(gel=(20.0, 0.45))
    one, two, other = (phantom(template, truth, seed=s, settings=COARSE, jitter_mm=0.3) for s in (5, 5, 6))
    for name in ("initial", "pressed"):
        assert np.array_equal(one.experiment.state(name).markers.points, two.experiment.state(name).markers.points)
    assert one.truth == two.truth
    shift = np.concatenate([p.specimen.free - marker_lattice(template) for p in (one, other)])
    assert shift.std() == pytest.approx(0.3, rel=0.25)
    assert not np.array_equal(one.specimen.free, other.specimen.free)


def volume(gel: VirtualSpecimen, state: str) -> float:
    """Volume of the gel in a state over that in the free one, from the mesh's own integration points."""
    u = gel.solutions[state].displacement
    table = elements(gel.model.mesh)
    nodes = u[table.connectivity]
    f = np.eye(3) + np.einsum("mai,mqaj->mqij", nodes, table.gradients)
    return float((table.weights * np.linalg.det(f)).sum() / table.weights.sum())


def test_a_nearly_incompressible_gel_keeps_its_volume():
    changes = []
    for nu in (0.3, 0.49, 0.499):
        made = virtual_specimen(plate(), truth_of(gel=(20.0, nu)), settings=COARSE)
        changes.append(1 - volume(made, "pressed"))
    assert 0.08 < changes[0] < 0.25  # of 25 % compression
    assert changes[1] < 0.012
    assert 0 < changes[2] < 0.0015


def test_a_gel_that_slips_freely_is_pressed_uniformly():
    truth = truth_of(gel=(20.0, 0.45)) | rubbing(0.0, "gel")
    made = virtual_specimen(plate(), truth, settings=COARSE)
    stretches = uniaxial(material(young_modulus=20.0, poisson_ratio=0.45), 0.75).stretches
    np.testing.assert_allclose(made.loaded["pressed"], registered(made, stretches), atol=0.01)


def registered(gel: VirtualSpecimen, stretches: np.ndarray) -> np.ndarray:
    """The stretched lattice; a slippery gel may drift and turn on its table."""
    return registration(gel.free * stretches, gel.loaded["pressed"]).applied(gel.free * stretches)


def test_the_softer_layer_gives_way():
    template = plate(("soft", 20.0), ("hard", 20.0))
    made = virtual_specimen(template, truth_of(soft=(10.0, 0.45), hard=(40.0, 0.45)), settings=COARSE)
    z = made.loaded["pressed"][:, 2].reshape(3, 9).mean(axis=1)
    below, above = 1 - (z[1] - z[0]) / 10, 1 - (z[2] - z[1]) / 10
    assert below > 2 * above > 0.1
    assert made.truth["twin/pressed: height"] == 30


def test_the_opening_may_differ_from_the_nominal_one():
    template = plate()
    truth = truth_of(gel=(20.0, 0.45)) | {platen_position(template, "pressed"): 35.0, "twin/pressed: tilt_x": 0.01}
    made = phantom(template, truth, seed=0, settings=COARSE, scanner=EXACT)
    assert made.truth[platen_position(template, "pressed")] == 35.0
    assert made.experiment.state("pressed").stated_mm == 30.0
    top = made.specimen.solutions["pressed"].displacement[np.flatnonzero(made.specimen.model.mesh.points[:, 2] == 40)]
    assert top[:, 2].mean() == pytest.approx(-5, abs=0.02)
    assert np.ptp(top[:, 2]) == pytest.approx(40 * 0.01, rel=0.1)


@pytest.mark.parametrize("loading", [Loading("bar", 12.0, "y"), Loading("bar", 12.0, "x")])
def test_a_bar_presses_across_its_axis(loading):
    template = box_experiment("twin", SIZE, [("gel", 40.0)], loading, {"pressed": 34.0})
    made = virtual_specimen(template, truth_of(gel=(20.0, 0.45)), settings=COARSE)
    top = made.free[:, 2] == 30
    under = made.free[:, 0 if loading.bar_axis == "y" else 1] == 0
    sunk = (made.free - made.loaded["pressed"])[:, 2]
    assert sunk[top & under].min() > 1.3 * sunk[top & ~under].max() > 3


def test_the_mesh_differs_from_that_of_identification():
    slim = box_experiment("slim", (20, 20, 40), [("gel", 40.0)], Loading("plate"), {"touched": 39.5}, margin_mm=5.0)
    made = virtual_specimen(slim, truth_of(gel=(20.0, 0.3)))
    z = np.unique(np.round(made.model.mesh.points[:, 2], 9))
    assert len(z) - 1 == 14
    inside = set(np.round(np.linspace(0, 40, 11), 9)[1:-1])
    assert inside & set(z) <= {20.0}


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ({young_modulus("gel"): 20.0}, "lacks gel: poisson_ratio"),
        (truth_of(gel=(20.0, 0.45)) | {"gel on glass: friction": 0.1}, "does not depend on 'gel on glass: friction'"),
        (truth_of(gel=(20.0, np.nan)), "finite"),
    ],
)
def test_bad_truths_are_refused(truth, words):
    with pytest.raises(InputError, match=words):
        virtual_specimen(plate(), truth, settings=COARSE)


def test_bad_descriptions_are_refused():
    with pytest.raises(InputError, match="add up"):
        plate(("a", 10.0))
    with pytest.raises(InputError, match="no room"):
        box_experiment("flat", (40, 40, 15), [("a", 15.0)], Loading("plate"), {"s": 10})
    with pytest.raises(InputError, match="not negative"):
        Scanner(placing_mm=-1)
    with pytest.raises(InputError, match="outside"):
        virtual_specimen(
            plate(), truth_of(gel=(20.0, 0.45)), settings=COARSE, markers=np.array([[0, 0, 10], [0, 0, 90], [1, 0, 3], [3, 1, 4.0]])
        )
