"""Studies of lattices: the same as steps taken by hand, balances, and going on after a stop."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.forward_model import PushedFace, PushedLattice, Pushing
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.simulation.loading_history import Drive, LatticeStudy, StudyBody, StudyFrame, run_study
from naibu.mechanics.prescribed_motion import PrescribedMotion

GRAVITY = 9810.0  # mm/s^2
LATTICE = classic_lattice(box_mask((3, 3, 2)), 10.0, total_mass_kg=0.05)
SOFT = lattice_parameters(LATTICE, {"short": 40.0, "normal": 25.0, "long": 15.0}, 10.0, 200.0)
SLIGHT = lattice_parameters(LATTICE, 40.0, 0.02, 0.5)  # explicit steps of 0.1 ms are stable


def still(name: str, indenter: RigidIndenter, **more: object) -> StudyBody:
    return StudyBody(name, indenter, **more)


def moving(name: str, indenter: RigidIndenter, rows: list[list[float]], **more: object) -> StudyBody:
    table = np.array(rows)
    return StudyBody(name, indenter, PrescribedMotion.through(table[:, 0], table[:, 1:]), **more)


def tied(**changes: object) -> LatticeStudy:
    box = box_indenter((-2.5, 15.0, 10.0), (5.0, 10.0, 10.0))
    path = [[0, 0, 0, 0], [0.1, 2, 0, 0], [0.2, 2, 0, 0], [0.3, -5, 0, 0]]
    bodies = (still("floor", plane_indenter((0, 0, 0)), tied_until_s=np.inf), moving("box", box, path, tied_until_s=0.15))
    return replace(LatticeStudy(LATTICE, SOFT, bodies, 0.002, 10, 4, 4), **changes)


def touching(**changes: object) -> LatticeStudy:
    ball = spherical_indenter(
        (15.0, 15.0, 31.0), 10.0, static_friction=0.4, kinetic_friction=0.3, pull_stiffness=10.0, pull_damping=1.0, pull_speed=50.0
    )
    floor = plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.4)
    path = [[0, 0, 0, 0], [0.1, 1, 0, -5], [0.2, 1, 0, 4]]
    weight = np.outer(LATTICE.node_mass, [0.0, 0.0, -GRAVITY])
    study = LatticeStudy(LATTICE, SOFT, (still("floor", floor), moving("ball", ball, path)), 0.002, 10, 4, 3, external_force=weight)
    return replace(study, **changes)


def driven(**changes: object) -> LatticeStudy:
    drive = Drive(np.array([0.0, 0.1]), np.array([0.0, 400.0]), np.array([0.0, 0.0, -1.0]), 0.05)
    box = box_indenter((15.0, 15.0, 25.0), (40.0, 40.0, 10.0), static_friction=0.4, kinetic_friction=0.4)
    floor = plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.4)
    study = LatticeStudy(LATTICE, SOFT, (still("floor", floor), still("box", box, drive=drive)), 0.002, 6, 5, 5)
    return replace(study, **changes)


def test_a_study_is_the_pushing_that_calibration_computes() -> None:
    """The box of the study and the box of nodes of a `Pushing` touch the same nodes, and what follows is the same motion."""
    pushing = Pushing("push", (PushedFace((0.0, 10.0, 10.0), (0.0, 20.0, 20.0), (20.0, 0.0, 0.0)),), 0.1, 0.1, 0.12, (0.0, 0.1, 0.2, 0.32))
    expected = PushedLattice.of(LATTICE, pushing).run(SOFT, tolerance=1e-6)
    box = box_indenter((-2.5, 15.0, 15.0), (5.0, 10.0, 10.0))
    bodies = (
        still("floor", plane_indenter((0, 0, 0)), tied_until_s=np.inf),
        moving("box", box, [[0, 0, 0, 0], [0.1, 2, 0, 0]], tied_until_s=0.2),
    )
    frames = list(run_study(LatticeStudy(LATTICE, SOFT, bodies, 0.002, 16, 10, 1, tolerance=1e-6)))
    for time, position in zip(pushing.capture_s, expected.positions, strict=True):
        frame = frames[round(time / 0.02)]
        assert frame.time == pytest.approx(time)
        np.testing.assert_allclose(frame.state.lattice.position, position, atol=1e-6)
    force = np.concatenate([f.force for f in frames])[:100, 1]
    np.testing.assert_allclose(force, expected.force[:, 0], atol=1e-3 * np.abs(force).max())
    np.testing.assert_allclose(np.concatenate([f.sample_times for f in frames]), 0.002 * np.arange(1, 161))


@pytest.mark.parametrize(
    "study", [tied(tolerance=1e-6), touching(tolerance=1e-6), driven(tolerance=1e-6)], ids=["tied", "touching", "driven"]
)
def test_impulses_make_the_momentum_and_work_is_stored_or_dissipated(study: LatticeStudy) -> None:
    frames = list(run_study(study))
    assert [f.time for f in frames] == pytest.approx([study.frame_s * k for k in range(study.frames + 1)])
    impulse = study.sample_s * sum(f.force.sum(axis=(0, 1)) for f in frames)
    if study.external_force is not None:
        impulse = impulse + study.external_force.sum(axis=0) * study.frames * study.frame_s
    size = study.sample_s * sum(np.abs(f.force).sum() for f in frames)
    np.testing.assert_allclose(frames[-1].momentum, impulse, atol=1e-4 * size)
    lost = np.array([f.state.work.sum() + f.state.external_work - f.kinetic - f.spring for f in frames])
    assert (np.diff(lost) > -1e-3 * lost.max()).all() and lost[-1] > 0.0


def test_the_driven_body_is_in_balance() -> None:
    """Force on the body, less that of the object, accelerates it."""
    study = driven(tolerance=1e-6)
    frames = list(run_study(study))
    force = np.concatenate([f.force for f in frames])[:, 1, 2]
    times = study.step_s * np.arange(1, 151)
    applied = np.interp(times, [0.0, 0.1], [0.0, 400.0]).sum() * study.step_s
    assert 0.05 * frames[-1].state.speed == pytest.approx(applied + force.sum() * study.sample_s, abs=2e-3 * applied)
    assert frames[-1].state.positions[1, 2] < 24.9


@pytest.mark.parametrize(
    "study", [tied(), tied(method="euler", step_s=1e-4, samples=8, sample_steps=5, parameters=SLIGHT), touching(), driven()]
)
def test_a_run_that_stopped_goes_on_as_if_it_had_not(study: LatticeStudy) -> None:
    whole = list(run_study(study))
    part = list(islice(run_study(study), 4))
    rest = list(run_study(study, part[-1].state))
    for a, b in zip(whole, part + rest, strict=True):
        same(a, b)


def same(a: StudyFrame, b: StudyFrame) -> None:
    assert (a.time, a.kinetic, a.spring, a.state.speed, a.state.external_work) == (
        b.time,
        b.kinetic,
        b.spring,
        b.state.speed,
        b.state.external_work,
    )
    for name in ("position", "velocity", "extension"):
        assert (getattr(a.state.lattice, name) == getattr(b.state.lattice, name)).all()
    assert (a.force == b.force).all() and (a.state.work == b.state.work).all() and (a.state.positions == b.state.positions).all()


def test_a_body_lets_go_when_it_is_to() -> None:
    frames = list(run_study(tied()))
    times = np.concatenate([f.sample_times for f in frames])
    force = np.concatenate([f.force for f in frames])[:, 1]
    assert (force[times > 0.15 + 0.008] == 0.0).all() and (np.abs(force[times < 0.15 - 0.008]).max(axis=1) > 0.0).all()
    np.testing.assert_allclose(frames[-1].state.positions[1], [-2.5 - 5.0, 15.0, 10.0])


def test_what_cannot_be_run_is_told() -> None:
    ball = spherical_indenter((15.0, 15.0, 31.0), 10.0)
    floor = still("floor", plane_indenter((0, 0, 0)))
    path = [[0.0, 0, 0, 0], [1.0, 0, 0, -5]]
    for study, words in (
        (touching(method="euler"), "needs method 'implicit' or 'symplectic_euler'"),
        (touching(bodies=(floor, moving("ball", ball, path, tied_until_s=1.0))), "floor cannot be in contact"),
        (tied(bodies=(moving("ball", ball, path, tied_until_s=1.0),)), "ball touches no node, the nearest is 3.077"),
        (driven(bodies=(*driven().bodies, moving("ball", spherical_indenter((15.0, 15.0, 60.0), 5.0), path))), "ball cannot move"),
        (touching(bodies=(floor, still("ball", spherical_indenter((15.0, 15.0, 25.0), 10.0)))), "begins inside the object"),
    ):
        with pytest.raises(InputError, match=words):
            next(run_study(study))


def test_a_study_in_contact_goes_the_same_way_in_short_explicit_and_implicit_steps() -> None:
    """The ball comes down on the block, with friction, and goes up again: both methods, at steps so short that they agree."""
    steps = {"step_s": 1e-4, "frames": 3, "samples": 2, "sample_steps": 250, "parameters": SLIGHT}
    found = [list(run_study(touching(method=method, **steps))) for method in ("implicit", "symplectic_euler")]
    forces = np.array([[frame.force for frame in run[1:]] for run in found])
    assert np.abs(forces[0][..., 2]).max() > 10.0
    np.testing.assert_allclose(forces[1], forces[0], atol=0.02 * np.abs(forces[0]).max())
    ends = [run[-1].state.lattice.position for run in found]
    np.testing.assert_allclose(ends[1], ends[0], atol=0.02)
