"""A cut that a thread prepares, with the factors of the body behind it, while the body goes on moving."""

from __future__ import annotations

import threading
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import NaibuError
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.simulation.interactive_bodies import FiniteElementBody

PART = 0.1  # of a step, in which volume strains come to balance


@dataclass(slots=True, eq=False)
class BackgroundCut:
    """A cut under way.

    Attributes
    ----------
    body : FiniteElementBody
        What is cut.
    """

    body: FiniteElementBody
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
        return body, DynamicState(found.nodal(state.displacement) + settled, found.nodal(state.velocity))

    def wait(self) -> None:
        """Wait for the thread."""
        if self._thread is not None:
            self._thread.join()

    def _run(self, state: DynamicState, blade: SweptBlade, distance_mm: float | None) -> None:
        try:
            body, behind, found = self.body.cut(state, blade, distance_mm)
            self._made = body, found, _settled(body, behind)
        except BaseException as error:
            self._failure = error


def _settled(body: FiniteElementBody, behind: DynamicState) -> FloatArray:
    """Return the displacement (n, 3), mm, by which volume strains behind a cut come to balance, and keep the tangent there.

    The cut divides the patches over which volume strains are averaged: in a nearly incompressible body that makes large pressures, and a
    balance that the first frame behind the cut would take seconds to find. In a small part of a step, begun at rest, they vanish, while
    weight and other forces move the body by next to nothing.
    """
    settled, still = behind.displacement, np.zeros_like(behind.velocity)
    with suppress(NaibuError):  # whoever steps it next is told
        with closing(replace(body, engine=replace(body.engine, step=PART * body.step_s)).session()) as session:
            session.restore(DynamicState(settled, still))
            session.step(body.grip_velocity(np.zeros(3)), [])
            settled = session.state().displacement
        with closing(body.session()) as session:
            session.restore(DynamicState(settled, still))
            if isinstance(session, RealTimeSession):
                session.keep_tangent()
    return np.asarray(settled - behind.displacement)
