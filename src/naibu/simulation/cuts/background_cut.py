"""Cuts of finite elements with the balance and the factors of the body behind them, prepared at once or by a thread as the body goes on."""

from __future__ import annotations

import threading
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import NaibuError
from naibu.mechanics.finite_strain.lip_assembly import with_friction
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine, DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.simulation.cuts.lattice_cut import LatticeCut
from naibu.simulation.interactive_bodies import AnySession, FiniteElementBody, InteractiveBody

CUT_STAGES = ("separating the mesh", "bringing volume strains to balance", "factorizing the stiffness", "lifting the tool")
PART = 0.1  # of a step, in which volume strains come to balance
DIVISIONS = 2  # of that part: where a tool squeezes the body, it finds none in shorter ones either, and they take most of the time
SHARES = (0.0, 0.25, 0.5, 1.0)  # of the way to that balance that are tried, as the body may have moved on since it was found


@dataclass(slots=True, eq=False)
class BackgroundCut:
    """A cut under way.

    Attributes
    ----------
    body : FiniteElementBody
        What is cut.
    stage : int
        Number in `CUT_STAGES` of what is being computed; the last one where that is done.
    """

    body: FiniteElementBody
    stage: int = field(init=False, default=0)
    _made: tuple[FiniteElementBody, VolumeCut, FloatArray] | None = field(init=False, default=None)
    _failure: BaseException | None = field(init=False, default=None)
    _thread: threading.Thread | None = field(init=False, default=None)

    def begin(self, state: DynamicState, blade: SweptBlade, distance_mm: float | None) -> None:
        """Start the thread, with the state of the body as the blade passes; see `FiniteElementBody.cut`."""
        self._thread = threading.Thread(target=self._run, args=(state, blade, distance_mm), name="naibu cut", daemon=True)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether the thread has ended."""
        return self._thread is not None and not self._thread.is_alive()

    def result(self, state: DynamicState) -> tuple[FiniteElementBody, DynamicState]:
        """Return the body behind the cut, and what has become of its state.

        Raises
        ------
        InputError
            What `naibu.meshing.cut_volume` refuses.
        """
        if self._failure is not None:
            raise self._failure
        assert self._made is not None
        body, found, settled = self._made
        at = found.nodal(state.displacement)
        return body, DynamicState(at + _share_that_helps(body, at, settled) * settled, found.nodal(state.velocity))

    def wait(self) -> None:
        """Wait for the thread."""
        if self._thread is not None:
            self._thread.join()

    def prepare(self, state: DynamicState, blade: SweptBlade, distance_mm: float | None) -> VolumeCut:
        """Do at once what the thread of `begin` does, and return the cut.

        Raises
        ------
        InputError
            What `naibu.meshing.cut_volume` refuses.
        """
        body, behind, found = self.body.cut(state, blade, distance_mm)
        self.stage = 1
        settled = _settled(body, behind)
        self.stage = 2
        _keep_tangent(body, settled)
        self._made = body, found, settled - behind.displacement
        return found

    def _run(self, state: DynamicState, blade: SweptBlade, distance_mm: float | None) -> None:
        try:
            self.prepare(state, blade, distance_mm)
        except BaseException as error:
            self._failure = error
        self.stage = len(CUT_STAGES) - 1


def cut_in_balance(
    body: InteractiveBody, session: AnySession, blade: SweptBlade, distance_mm: float | None
) -> tuple[InteractiveBody, Any, VolumeCut | LatticeCut]:
    """Return the body of a session and its state behind a cut, where finite elements are in balance, and their tangent is at hand.

    Parameters
    ----------
    body : InteractiveBody
        What is cut.
    session : session of the body
        With its state as the blade passes.
    blade : SweptBlade
        The surface that it sweeps.
    distance_mm : float, optional
        See `FiniteElementBody.cut`.

    Raises
    ------
    InputError
        What the body's own `cut` refuses.
    """
    state = body.without_contact(session.state())
    if not isinstance(body, FiniteElementBody):
        return body.cut(state, blade, distance_mm)
    cutting = BackgroundCut(body)
    found = cutting.prepare(state, blade, distance_mm)
    return *cutting.result(state), found


def _share_that_helps(body: FiniteElementBody, at: FloatArray, settled: FloatArray) -> float:
    """Return the share of a way (n, 3), mm, that leaves least out of balance from displacements (n, 3), mm, and inverts no element.

    The way is that to the balance of the body as the blade passed. Where the body has moved on by much until the cut opens, as where a tool
    squeezed it then, that way would fling it, and invert elements, from which it finds no balance any more: 0 where none of it helps.
    """
    weight = body.engine.mass[:, None] * body.gravity

    def left(share: float) -> float:
        _, internal, smallest = body.engine.assembler.forces(at + share * settled)
        wrong = np.abs(internal - weight)
        wrong[body.supported] = 0.0
        return float(wrong.sum()) if smallest > 0.0 else np.inf

    return min(SHARES, key=left)


def _settled(body: FiniteElementBody, behind: DynamicState) -> FloatArray:
    """Return the displacement (n, 3), mm, at which volume strains behind a cut have come to balance.

    The cut divides the patches over which volume strains are averaged: in a nearly incompressible body that makes large pressures, and a
    balance that the first frame behind the cut would take seconds to find. In a small part of a step, begun at rest, they vanish, while
    weight and other forces move the body by next to nothing: first without friction of the sides, which Newton's method balances in a
    tenth of the time, then with it.
    """
    e, settled = body.engine, behind.displacement
    for assembler in (with_friction(e.assembler, 0.0), e.assembler) if e.assembler.unsymmetric else (e.assembler,):
        newton = DynamicEngine(
            e.points, assembler, e.mass, e.faces, PART * e.step, e.normal_stiffness, e.tangential_stiffness, divisions=DIVISIONS
        )
        with suppress(NaibuError), closing(replace(body, engine=newton).session()) as session:  # whoever steps it next is told
            session.restore(DynamicState(settled, np.zeros_like(settled)))
            session.step(body.grip_velocity(np.zeros(3)), [])
            settled = np.asarray(session.state().displacement)
    return settled


def _keep_tangent(body: FiniteElementBody, settled: FloatArray) -> None:
    """Keep the tangent at a displacement (n, 3), mm, for the sessions of a body."""
    with suppress(NaibuError), closing(body.session()) as session:
        session.restore(DynamicState(settled, np.zeros_like(settled)))
        if isinstance(session, RealTimeSession):
            session.keep_tangent()
