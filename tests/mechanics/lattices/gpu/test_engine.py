"""Lattices on a device of Warp against the engine of the processor, against conservation laws, and compiled for CUDA."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from naibu.core.errors import ConvergenceError, InputError, MissingDependencyError
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import plane_indenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.gpu.engine import WarpLatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState

METHODS = ("implicit", "euler", "symplectic_euler")
EXPLICIT_STEP_S = 1e-4


@pytest.fixture(scope="module", params=["cpu", "cuda:0"])
def device(request):
    warp = pytest.importorskip("warp")
    if request.param.startswith("cuda") and not warp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


def random_mask(shape=(5, 6, 4), seed=2):
    """Return a connected mask without any order: a full layer below, random voxels above it that hang on one another."""
    mask = np.random.default_rng(seed).random(shape) < 0.6
    mask[:, :, 0] = True
    return np.logical_and.accumulate(mask, axis=2)


LATTICES = {
    "classic": lambda: classic_lattice(box_mask((6, 5, 7)), 10.0, total_mass_kg=0.4),
    "octree": lambda: octree_lattice(box_mask((8, 8, 8)), 5.0, total_mass_kg=0.1),
    "mask": lambda: classic_lattice(random_mask(), 10.0, total_mass_kg=0.2),
}


def parameters_of(lattice, each=False):
    """Return parameters by class and zone, or other ones for each element."""
    if not each:
        return lattice_parameters(lattice, {"core": {"short": 9.0, "normal": 4.0, "long": 2.0}, "surface": 12.0}, 0.01, 0.03)
    rng = np.random.default_rng(5)
    return lattice_parameters(lattice, *(p * rng.uniform(0.5, 1.5, lattice.n_elements) for p in (9.0, 0.01, 0.03)))


def pushed(lattice):
    """Return a floor that holds masses by their heights, a roller and a handle with weights, and their velocities."""
    x, y, z = lattice.points.T
    tilted = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0][:2]
    corner = np.argmax(x + y + z)
    handle = ConstrainedNodes(np.array([corner, corner]), tilted, np.array([0.7, 1.0]), np.array([2, 1]))
    roller = ConstrainedNodes.of(np.flatnonzero((x == x.max()) & (z > 0) & (np.arange(len(x)) != corner)), 1, axes=(0,), weight=0.5)
    return ConstrainedNodes.of(np.flatnonzero(z == 0.0), 0) + roller + handle, [[0, 0, 0], [9.0, 1.0, 4.0], [-5.0, 7.0, -20.0]]


def spinning(lattice, seed=0, speed=3.0):
    rng = np.random.default_rng(seed)
    velocity = speed * rng.normal(size=lattice.points.shape) + np.cross([0.5, -2.0, 3.0], lattice.points)
    return LatticeState(lattice.points, velocity, 0.03 * rng.normal(size=lattice.n_elements))


def momenta(lattice, state):
    linear = lattice.node_mass[:, None] * state.velocity
    return linear.sum(axis=0), np.cross(state.position, linear).sum(axis=0)


def assert_alike(found, expected, digits):
    for name in ("position", "velocity", "extension"):
        one, other = getattr(found.state, name), getattr(expected.state, name)
        np.testing.assert_allclose(one, other, rtol=0, atol=digits * np.abs(other).max(), err_msg=name)
    np.testing.assert_allclose(found.reaction, expected.reaction, rtol=0, atol=10.0 * digits * np.abs(expected.reaction).max(initial=0.0))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", LATTICES)
def test_it_moves_as_on_the_processor(device, kind, method):
    lattice = LATTICES[kind]()
    parameters = parameters_of(lattice, each=kind == "mask")
    options = {"method": method, "step": 2e-3 if method == "implicit" else EXPLICIT_STEP_S, "tolerance": 1e-6}
    constrained, velocity = pushed(lattice)
    motions = []
    for engine in (LatticeEngine.of(lattice, parameters, **options), WarpLatticeEngine.of(lattice, parameters, device=device, **options)):
        motions.append(engine.run(spinning(lattice), 200 if method != "implicit" else 50, constrained, velocity, [0.0, 0.01, -0.02]))
    assert_alike(motions[1], motions[0], 1e-11 if method != "implicit" else 2e-6)
    assert np.abs(motions[0].state.position - lattice.points).max() > 0.1


def test_single_precision_differs_in_the_last_digits_only(device):
    lattice = LATTICES["classic"]()
    constrained, velocity = pushed(lattice)
    runs = []
    for precision in ("double", "single"):
        options = {"method": "euler", "step": EXPLICIT_STEP_S, "precision": precision, "device": device}
        runs.append(WarpLatticeEngine.of(lattice, parameters_of(lattice), **options).run(spinning(lattice), 200, constrained, velocity))
    assert_alike(runs[1], runs[0], 1e-4)
    assert np.abs(runs[1].state.position - runs[0].state.position).max() > 0.0


@pytest.mark.parametrize("method", METHODS)
def test_a_session_goes_on_where_it_was(device, method):
    """Steps in several calls, also more than fit on the device at once, are those of one call; twice the same are the same."""
    lattice = classic_lattice(box_mask((2, 2, 2)), 10.0, total_mass_kg=0.02)
    engine = WarpLatticeEngine.of(lattice, parameters_of(lattice), step=EXPLICIT_STEP_S, method=method, device=device)
    constrained = ConstrainedNodes.of([0, 1, 2]) + ConstrainedNodes.of([20], 1)
    path = np.zeros((300, 2, 3))
    path[:, 1, 2] = 10.0 * np.sin(0.05 * np.arange(300))
    whole = engine.run(spinning(lattice), 300, constrained, path)
    session = engine.session(spinning(lattice), constrained)
    reaction = np.concatenate([session.step(part, steps=len(part)).bodies for part in (path[:7], path[7:280], path[280:])])
    np.testing.assert_array_equal(reaction, whole.reaction)
    np.testing.assert_array_equal(session.state().position, whole.state.position)


def test_both_copies_of_an_extension_stay_the_same_to_the_last_bit(device):
    lattice = LATTICES["mask"]()
    for method in METHODS:
        engine = WarpLatticeEngine.of(lattice, parameters_of(lattice, each=True), step=EXPLICIT_STEP_S, method=method, device=device)
        session = engine.session(spinning(lattice))
        session.step(steps=50)
        copies = session.y.numpy()[engine.lists.places]
        np.testing.assert_array_equal(copies[:, 0], copies[:, 1])
        assert np.abs(copies).max() > 0.0


@pytest.mark.parametrize(("method", "tolerance"), [("implicit", 0.3), ("implicit", 1e-2), ("symplectic_euler", 0.5)])
def test_a_free_body_keeps_both_momenta(device, method, tolerance):
    lattice = LATTICES["mask"]()
    engine = WarpLatticeEngine.of(lattice, parameters_of(lattice), step=EXPLICIT_STEP_S, method=method, tolerance=tolerance, device=device)
    start = spinning(lattice, speed=30.0)
    end = engine.run(start, 300).state
    for before, after in zip(momenta(lattice, start), momenta(lattice, end), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-10 * np.abs(before).max())
    assert np.abs(end.velocity - start.velocity).max() > 10.0


@pytest.mark.parametrize("method", METHODS)
def test_a_free_body_falls_as_the_steps_of_its_centre_tell(device, method):
    lattice = LATTICES["classic"]()
    weight = lattice.node_mass[:, None] * [0.0, 0.0, -9810.0]
    engine = WarpLatticeEngine.of(lattice, parameters_of(lattice), step=1e-4, method=method, device=device)
    end = engine.run(engine.rest(), 150, external_force=weight).state
    t, h = 150 * engine.step, engine.step
    fallen = -0.5 * 9810.0 * t * (t - h if method == "euler" else t + h)
    np.testing.assert_allclose(end.velocity, np.broadcast_to([0.0, 0.0, -9810.0 * t], end.velocity.shape), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(end.position - lattice.points, np.broadcast_to([0.0, 0.0, fallen], end.position.shape), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_energy_of_implicit_steps_never_grows(device, seed):
    rng = np.random.default_rng(seed)
    lattice = classic_lattice(box_mask((2, 2, 2)), 10.0, total_mass_kg=10.0 ** rng.uniform(-3, 0))
    draw = [
        np.exp(rng.uniform(np.log(low / 100), np.log(100 * high), lattice.n_elements)) for low, high in ((0.5, 30), (0.1, 20), (0.5, 30))
    ]
    parameters = lattice_parameters(lattice, *draw)
    engine = WarpLatticeEngine.of(lattice, parameters, tolerance=10.0 ** rng.uniform(-6, -0.05), device=device)
    start = spinning(lattice, seed, speed=10.0 ** rng.uniform(-2, 3))
    constrained = ConstrainedNodes.of([0, 1, 2]) if seed % 2 else None
    if constrained is not None:
        start.velocity[:3] = 0.0
    session, found = engine.session(start, constrained), [engine.energy(start)]
    for _ in range(20):
        session.step(steps=1)
        found.append(engine.energy(session.state()))
    assert np.diff(found).max() <= 1e-9 * found[0]


def test_rotation_is_held_back_as_on_the_processor(device):
    """Turns of more than a radian a step stretch more than dissipates: both engines hold back, and both catch up."""
    lattice = classic_lattice(box_mask((1, 1, 2)), 10.0, total_mass_kg=0.05)
    parameters = lattice_parameters(lattice, 50.0, 0.01, 100.0)
    start = LatticeState(lattice.points, np.cross([0.0, 100.0, 300.0], lattice.points - 10.0), np.zeros(lattice.n_elements))
    one = LatticeEngine.of(lattice, parameters, tolerance=1e-10).run(start, 15)
    two = WarpLatticeEngine.of(lattice, parameters, tolerance=1e-10, device=device).run(start, 15)
    assert two.rotation_limited == one.rotation_limited > 0
    assert_alike(two, one, 1e-6)
    np.testing.assert_allclose(two.state.length, one.state.length, rtol=1e-6)


@pytest.mark.parametrize("arch", [80, 90])
def test_the_kernels_compile_for_cuda_without_a_gpu(arch, tmp_path):
    warp = pytest.importorskip("warp")
    from naibu.mechanics.lattices.gpu import _coarse_kernels, _explicit_kernels, _implicit_kernels

    warp.init()
    if warp.get_cuda_toolkit_version() is None:
        pytest.skip("this Warp was built without CUDA")
    for module in (_coarse_kernels, _explicit_kernels, _implicit_kernels):
        warp.compile_aot_module(module, arch=arch, module_dir=tmp_path / module.__name__)
        assert any(path.suffix in (".ptx", ".cubin") and path.stat().st_size for path in (tmp_path / module.__name__).iterdir())


def test_without_warp_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    lattice = classic_lattice(box_mask((1, 1, 1)), 10.0, total_mass_kg=0.05)
    with pytest.raises(MissingDependencyError, match=r'pip install "naibu\[gpu\]"'):
        WarpLatticeEngine.of(lattice, lattice_parameters(lattice, 1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"device": "cuda:99"}, "no device 'cuda:99'"),
        ({"step": 0.0}, "step must be positive"),
        ({"tolerance": 1.0}, "below 1"),
        ({"method": "verlet"}, "not 'verlet'"),
        ({"precision": "half"}, "not 'half'"),
        ({"precision": "single"}, "double"),
    ],
)
def test_bad_options_are_named(options, said):
    pytest.importorskip("warp")
    lattice = classic_lattice(box_mask((1, 1, 1)), 10.0, total_mass_kg=0.05)
    with pytest.raises(InputError, match=said):
        WarpLatticeEngine.of(lattice, lattice_parameters(lattice, 1.0, 1.0, 1.0), **options)


def test_bad_states_are_named_and_explicit_steps_that_blow_up_say_so(device):
    lattice = LATTICES["classic"]()
    engine = WarpLatticeEngine.of(lattice, parameters_of(lattice), step=0.1, method="euler", device=device)
    rest = engine.rest()
    for state, said in (
        (LatticeState(rest.position[1:], rest.velocity, rest.extension), "position of the state has shape"),
        (LatticeState(rest.position, rest.velocity * np.nan, rest.extension), "velocity of the state holds"),
    ):
        with pytest.raises(InputError, match=said):
            engine.run(state, 1)
    with pytest.raises(InputError, match="constrained nodes have the numbers"):
        engine.run(rest, 1, ConstrainedNodes.of([lattice.n_nodes]))
    with pytest.raises(ConvergenceError, match="diverged within 200 steps"):
        engine.run(spinning(lattice), 200)


@pytest.mark.parametrize("method", ["implicit", "symplectic_euler"])
def test_a_session_changes_its_constraints_and_goes_back_to_a_state(device, method):
    """Constraints that are let go, a state put back: the same steps give the same numbers to the last bit."""
    lattice = classic_lattice(box_mask((3, 3, 4)), 10.0, total_mass_kg=0.05)
    parameters = lattice_parameters(lattice, 40.0, 0.02, 0.5)
    step = 2e-3 if method == "implicit" else EXPLICIT_STEP_S
    engine = WarpLatticeEngine.of(lattice, parameters, step=step, method=method, device=device)
    top, bottom = (np.flatnonzero(lattice.points[:, 2] == z) for z in (lattice.points[:, 2].max(), 0.0))
    both = ConstrainedNodes.of(bottom, 0) + ConstrainedNodes.of(top, 1)
    with engine.session(constrained=both) as session:
        session.step([[0, 0, 0], [0, 0, -20.0]], steps=20)
        kept = session.state()
        session.constrain(ConstrainedNodes.of(bottom, 0), 2)
        first = session.step(steps=20)
        end = session.positions()
        session.restore(kept)
        np.testing.assert_array_equal(session.step(steps=20).bodies, first.bodies)
        np.testing.assert_array_equal(session.positions(), end)
        assert session.forces().bodies.shape == (20, 2, 3) and not session.forces().bodies[:, 1].any()
    expected = engine.run(kept, 20, ConstrainedNodes.of(bottom, 0))
    np.testing.assert_array_equal(end, expected.state.position)


def test_contact_is_refused(device):
    lattice = classic_lattice(box_mask((2, 2, 2)), 10.0, total_mass_kg=0.05)
    engine = WarpLatticeEngine.of(lattice, lattice_parameters(lattice, 40.0, 10.0, 50.0), device=device)
    with pytest.raises(InputError, match="contact is computed by LatticeEngine"):
        engine.session(indenters=[plane_indenter((0, 0, 0))])
    with pytest.raises(InputError, match="motions has 1 entries for 0 indenters"):
        engine.session().step(motions=[IndenterVelocity()])
