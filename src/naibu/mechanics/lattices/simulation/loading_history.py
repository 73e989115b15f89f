"""Studies of lattices: indenters that follow loading histories, computed frame by frame and resumable."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import Engine, Session
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.contact_state import begin_contact, check_outside
from naibu.mechanics.lattices.model.contact_surface import ContactSurface
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, Method
from naibu.mechanics.lattices.simulation.contact import push, push_by_force
from naibu.mechanics.lattices.simulation.engine_selection import lattice_engine
from naibu.mechanics.lattices.simulation.tied_bodies import FacePoints, tied_constraints
from naibu.mechanics.prescribed_motion import PrescribedMotion

StudyEngine = Engine[LatticeState, ConstrainedNodes]


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Force history that drives a guided body.

    Attributes
    ----------
    times, force : ndarray, shape (k,)
        Force along the direction, mN, linear between the times, s, and constant behind the last one.
    direction : ndarray, shape (3,)
        In which the body is guided.
    mass_kg : float
        Of the body.
    """

    times: FloatArray
    force: FloatArray
    direction: FloatArray
    mass_kg: float


@dataclass(frozen=True, slots=True, eq=False)
class StudyBody:
    """A rigid indenter with its loading history.

    Attributes
    ----------
    name : str
        For tables and messages.
    indenter : Indenter
        Shape, place at the start, friction and pull-off.
    motion : PrescribedMotion or None
        Displacement of the body; None where it does not move.
    drive : Drive, optional
        Force that moves it instead; one body of a study at most, and the others then stand still.
    tied_until_s : float, optional
        Nodes that touch it at the start move with it until then, s, and are free of it afterwards; infinite for ever. None for contact.
    points : FacePoints, optional
        Of a tied body: points that hand its displacement over to the nodes around them, or its force if it is driven.
    """

    name: str
    indenter: RigidIndenter
    motion: PrescribedMotion | None = None
    drive: Drive | None = None
    tied_until_s: float | None = None
    points: FacePoints | None = None

    @property
    def by_force(self) -> bool:
        """Whether a force moves it."""
        return self.drive is not None

    def moved(self, times: FloatArray) -> FloatArray:
        """Return the displacement (k, 3), mm, at times (k,), s."""
        return np.zeros((len(times), 3)) if self.motion is None else self.motion.sampled(times)


@dataclass(frozen=True, slots=True, eq=False)
class LatticeStudy:
    """A lattice, its indenters with their loading histories, and the settings of the computation.

    Attributes
    ----------
    lattice, parameters : Lattice, LatticeParameters
        The object.
    bodies : tuple of StudyBody
        Either all tied, or all in contact.
    step_s : float
        s.
    frames : int
        Kept frames behind the first one, which is the rest.
    samples : int
        Samples of the forces in a frame.
    sample_steps : int
        Steps in a sample.
    method : str
        Of `naibu.mechanics.lattices.cpu.engine.LatticeEngine`.
    tolerance : float
        Of the implicit solver.
    external_force : ndarray, shape (n, 3), optional
        On the masses, mN, such as their weight.
    """

    lattice: Lattice
    parameters: LatticeParameters
    bodies: tuple[StudyBody, ...]
    step_s: float
    frames: int
    samples: int = 1
    sample_steps: int = 1
    method: Method = "implicit"
    tolerance: float = 1e-3
    external_force: FloatArray | None = None

    @property
    def sample_s(self) -> float:
        """Duration of a sample of the forces, s."""
        return self.sample_steps * self.step_s

    @property
    def frame_s(self) -> float:
        """Time between frames, s."""
        return self.samples * self.sample_s

    @property
    def tied(self) -> bool:
        """Whether nodes are tied to the bodies, rather than in contact with them."""
        return any(body.tied_until_s is not None for body in self.bodies) or not self.bodies

    @property
    def driven(self) -> int | None:
        """Number of the body that a force drives."""
        return next((k for k, body in enumerate(self.bodies) if body.drive is not None), None)


@dataclass(frozen=True, slots=True, eq=False)
class StudyState:
    """State of a study at a frame, from which it can be resumed.

    Attributes
    ----------
    frame : int
        The frame.
    lattice : LatticeState
        Nodes, elements and contacts.
    speed : float
        Of the driven body, mm/s.
    positions : ndarray, shape (bodies, 3)
        Centres of the bodies, mm.
    work : ndarray, shape (bodies,)
        Work of the bodies on the object since the start, mN mm.
    external_work : float
        Likewise of the external force.
    unsettled : int
        Steps so far whose contacts did not settle.
    """

    frame: int
    lattice: LatticeState
    speed: float
    positions: FloatArray
    work: FloatArray
    external_work: float
    unsettled: int


@dataclass(frozen=True, slots=True, eq=False)
class StudyFrame:
    """One frame of a study: time, state, energies and forces.

    Attributes
    ----------
    time : float
        s.
    state : StudyState
        All of it.
    kinetic, spring : float
        Energies, mN mm.
    momentum : ndarray, shape (3,)
        kg mm/s.
    sample_times : ndarray, shape (s,)
        Ends of the samples since the frame before, s.
    force : ndarray, shape (s, bodies, 3)
        Of the bodies on the object, mN: means over the samples. Force times duration is the impulse.
    """

    time: float
    state: StudyState
    kinetic: float
    spring: float
    momentum: FloatArray
    sample_times: FloatArray
    force: FloatArray


def check_study(study: LatticeStudy) -> None:
    """Check that a study can be run.

    Raises
    ------
    InputError
        Bodies both tied and in contact, contact by ``"euler"``, several driven bodies, or other bodies that move beside a driven
        one; bodies that start inside the object, or are tied to nothing.
    """
    if study.tied:
        loose = [body.name for body in study.bodies if body.tied_until_s is None]
        if loose:
            raise InputError(f"{', '.join(loose)} cannot be in contact while other bodies are tied: tie all, or none")
        rigid = [body.name for body in study.bodies if body.drive is not None and body.points is None]
        if rigid:
            raise InputError(
                f"{', '.join(rigid)} cannot be tied and driven by a force; give points that hand it over, or let it be in contact"
            )
        tied_constraints(study.lattice, study.bodies)
        return
    if study.method == "euler":
        raise InputError("contact with friction needs method 'implicit' or 'symplectic_euler', not 'euler'; or tie the bodies")
    driven = [body for body in study.bodies if body.drive is not None]
    if len(driven) > 1:
        raise InputError(f"{', '.join(b.name for b in driven)} are all driven by forces; one can be")
    moving = [body.name for body in study.bodies if body.drive is None and body.motion is not None]
    if driven and moving:
        raise InputError(f"{', '.join(moving)} cannot move while {driven[0].name} is driven by a force")
    check_outside(study.lattice, [body.indenter for body in study.bodies])


def begin_study(study: LatticeStudy) -> StudyState:
    """Return a study at rest.

    Raises
    ------
    InputError
        What `check_study` refuses.
    """
    check_study(study)
    indenters = [body.indenter for body in study.bodies]
    state = LatticeState.at_rest(study.lattice)
    if not study.tied:
        state = replace(state, contact=begin_contact(study.lattice, ContactSurface.of(study.lattice, study.parameters), indenters))
    positions = np.array([p.centre for p in indenters], dtype=float).reshape(-1, 3)
    return StudyState(0, state, 0.0, positions, np.zeros(len(indenters)), 0.0, 0)


def run_study(study: LatticeStudy, start: StudyState | None = None, *, device: str = "cpu") -> Iterator[StudyFrame]:
    """Compute a study frame by frame; nothing is kept of the frames that were yielded.

    Parameters
    ----------
    study : LatticeStudy
        What is computed.
    start : StudyState
        Of the last frame of an earlier run, which then goes on exactly as if it had not stopped. By default the run begins at rest, and
        yields that as its first frame.
    device : str
        See `naibu.mechanics.lattices.simulation.engine_selection.lattice_engine`; contact is computed on ``"cpu"`` only.

    Raises
    ------
    InputError
        What `check_study` refuses.
    ConvergenceError
        An explicit method diverged.
    """
    if not study.tied and device != "cpu":
        raise InputError(f"device is {device!r}, but contact with friction is computed on 'cpu' only; choose that, or tie all bodies")
    engine = lattice_engine(
        study.lattice, study.parameters, step=study.step_s, method=study.method, tolerance=study.tolerance, device=device
    )
    state = start
    if state is None:
        state = begin_study(study)
        yield _frame(study, engine, state, np.zeros((0, len(study.bodies), 3)))
    advance = (
        _Touching(study, engine).advance if isinstance(engine, LatticeEngine) and not study.tied else _Tied.of(study, engine, state).advance
    )
    while state.frame < study.frames:
        forces = []
        for sample in range(study.samples):
            state, force = advance(state, (state.frame * study.samples + sample) * study.sample_steps)
            forces.append(force)
        state = replace(state, frame=state.frame + 1)
        yield _frame(study, engine, state, np.array(forces).reshape(study.samples, len(study.bodies), 3))


def _frame(study: LatticeStudy, engine: StudyEngine, state: StudyState, force: FloatArray) -> StudyFrame:
    lattice, mass = state.lattice, study.lattice.node_mass
    kinetic = 0.5 * float(mass @ (lattice.velocity**2).sum(axis=1))
    first = max(state.frame - 1, 0) * study.samples
    times = np.asarray(study.sample_s * np.arange(first + 1, first + 1 + len(force)), dtype=np.float64)
    return StudyFrame(state.frame * study.frame_s, state, kinetic, engine.energy(lattice) - kinetic, mass @ lattice.velocity, times, force)


def _velocities(study: LatticeStudy, first: int) -> FloatArray:
    """Return the velocities (steps, bodies, 3), mm/s, of the steps of a sample."""
    ends = np.asarray(study.step_s * np.arange(first, first + study.sample_steps + 1), dtype=np.float64)
    return np.stack([np.diff(body.moved(ends), axis=0) / study.step_s for body in study.bodies], axis=1)


def _external_work(study: LatticeStudy, before: LatticeState, after: LatticeState) -> float:
    return 0.0 if study.external_force is None else float((study.external_force * (after.position - before.position)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Tied:
    """Steps of nodes that are tied to bodies, or that their points push."""

    study: LatticeStudy
    engine: StudyEngine
    session: Session[LatticeState, ConstrainedNodes] | None  # none where forces change from sample to sample
    constrained: tuple[ConstrainedNodes, ...]
    until: IntArray
    shares: dict[int, FloatArray]  # of the nodes in the forces of bodies

    @classmethod
    def of(cls, study: LatticeStudy, engine: StudyEngine, start: StudyState) -> _Tied:
        constrained = tied_constraints(study.lattice, study.bodies)
        ends = [body.tied_until_s for body in study.bodies]
        never = np.iinfo(np.int64).max
        until = np.array([never if end is None or np.isinf(end) else round(end / study.step_s) for end in ends], dtype=np.int64)
        shares = {k: b.points.shares(study.lattice) for k, b in enumerate(study.bodies) if b.by_force and b.points is not None}
        session = None if shares else engine.session(start.lattice, external_force=study.external_force)
        return cls(study, engine, session, constrained, until, shares)

    def advance(self, state: StudyState, first: int) -> tuple[StudyState, FloatArray]:
        """Take the steps of a sample, in pieces between which bodies let go."""
        study, last = self.study, first + self.study.sample_steps
        bodies = len(study.bodies)
        stops = [first, *sorted({int(u) for u in self.until if first < u < last}), last]
        work, impulse = state.work.copy(), np.zeros((bodies, 3))
        path = _velocities(study, first) if bodies else np.zeros((study.sample_steps, 0, 3))
        lattice = state.lattice
        for begin, end in pairwise(stops):
            constrained = ConstrainedNodes.none()
            for mine, until in zip(self.constrained, self.until, strict=True):
                constrained = constrained + mine if until > begin else constrained
            own, forces = path[begin - first : end - first], self._forces(begin, end)
            session = self.session or self.engine.session(lattice, external_force=self._pushed(forces))
            session.constrain(constrained, bodies)
            reaction = session.step(own, steps=end - begin).bodies
            before, lattice = lattice, session.state()
            work += study.step_s * (reaction * own).sum(axis=(0, 2))
            impulse += study.step_s * reaction.sum(axis=0)
            for k, force in forces.items():
                work[k] += float(force @ (self.shares[k] @ (lattice.position - before.position)))
                impulse[k] += (end - begin) * study.step_s * force
        external = state.external_work + _external_work(study, state.lattice, lattice)
        moved = [body.moved(np.array([study.step_s * last]))[0] + body.indenter.centre for body in study.bodies]
        for k, share in self.shares.items():
            moved[k] = study.bodies[k].indenter.centre + share @ (lattice.position - study.lattice.points)
        positions = np.array(moved).reshape(-1, 3)
        return StudyState(state.frame, lattice, 0.0, positions, work, external, 0), impulse / study.sample_s

    def _forces(self, begin: int, end: int) -> dict[int, FloatArray]:
        """Return the mean forces (3,), mN, of bodies that are driven, between two steps; none of those that have let go."""
        found = {}
        for k in self.shares:
            drive = self.study.bodies[k].drive
            assert drive is not None
            times = self.study.step_s * (np.arange(begin, end) + 0.5)
            mean = float(np.interp(times, drive.times, drive.force).mean()) if self.until[k] > begin else 0.0
            found[k] = mean * drive.direction / np.linalg.norm(drive.direction)
        return found

    def _pushed(self, forces: dict[int, FloatArray]) -> FloatArray:
        """Return the forces on all nodes (n, 3), mN."""
        given = self.study.external_force
        total = np.zeros((self.study.lattice.n_nodes, 3)) if given is None else given.copy()
        for k, force in forces.items():
            total += np.outer(self.shares[k], force)
        return total


@dataclass(frozen=True, slots=True, eq=False)
class _Touching:
    """Steps in contact."""

    study: LatticeStudy
    engine: LatticeEngine

    def advance(self, state: StudyState, first: int) -> tuple[StudyState, FloatArray]:
        """Take the steps of a sample."""
        study, driven = self.study, self.study.driven
        indenters = [body.indenter for body in study.bodies]
        speed = state.speed
        if driven is None:
            motion = push(self.engine, state.lattice, indenters, _velocities(study, first), external_force=study.external_force)
        else:
            drive = study.bodies[driven].drive
            assert drive is not None
            ends = study.step_s * np.arange(first + 1, first + study.sample_steps + 1)
            direction = drive.direction / np.linalg.norm(drive.direction)
            motion = push_by_force(
                self.engine, state.lattice, indenters, np.interp(ends, drive.times, drive.force), driven=driven, direction=direction,
                indenter_mass=drive.mass_kg, speed=speed, external_force=study.external_force,
            )  # fmt: skip
            speed = float(motion.speed[-1, driven] @ direction)
        work = state.work + study.step_s * (motion.reaction * motion.speed).sum(axis=(0, 2))
        external = state.external_work + _external_work(study, state.lattice, motion.state)
        assert motion.state.contact is not None
        after = StudyState(
            state.frame, motion.state, speed, motion.state.contact.centres, work, external, state.unsettled + motion.unsettled
        )
        return after, motion.reaction.mean(axis=0)
