"""Sessions in real time whose steps Newton's method takes where nothing else finds their balance, in a thread while a loop goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from concurrent.futures import Future
from copy import copy
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession
from naibu.mechanics.finite_strain.sessions.implicit_step import ImplicitStep
from naibu.mechanics.finite_strain.sessions.tangent_session import TangentSession

NEWTON_S = 10.0  # of a processor for Newton's method in a step for which a loop waits


@dataclass(slots=True, eq=False)
class NewtonSession(TangentSession):
    """A body in motion whose steps Newton's method can take; see `TangentSession` for the other attributes.

    Attributes
    ----------
    newton_steps : int
        Steps so far that Newton's method had to take.
    """

    newton_steps: int = field(init=False, default=0)
    _newton_until: float = field(init=False, default=np.inf)  # processor time at which Newton's method gives a step up

    def _newtons_beside(self, moving: FloatArray, contacts: tuple[Contact, ...]) -> Generator[None, None, FloatArray | None]:
        """Return what Newton's method finds for a step, as `DynamicSession._balanced`; a thread looks for it, with a copy of the session.

        The loop may give the step up meanwhile, and go on from another state.
        """
        apart = copy(self)
        apart._solver = None
        found: Future[FloatArray | None] = Future()
        threading.Thread(target=apart._hand_over, args=(moving, contacts, found), name="naibu Newton", daemon=True).start()
        try:
            while not found.done():
                yield from self._pause()
        finally:
            apart._newton_until = -np.inf
        return found.result()

    def _hand_over(self, moving: FloatArray, contacts: tuple[Contact, ...], found: Future[FloatArray | None]) -> None:
        """Hand over what Newton's method finds for a step."""
        try:
            self._newton_until = min(self._newton_until, time.thread_time() + NEWTON_S)
            found.set_result(DynamicSession._balanced(self, self.engine.step, moving, contacts))
        except BaseException as error:
            found.set_exception(error)

    def _found(self, step: ImplicitStep, guess: FloatArray) -> FloatArray | None:
        """Return the balance of a step near a guess, of a whole step also where the tangent is indefinite; None where there is none."""
        if time.thread_time() > self._newton_until:
            return None
        if step.duration < self.engine.step or step.assembler.unsymmetric:
            return DynamicSession._found(self, step, guess)
        try:
            return step.damped(guess, self._solved)
        except ConvergenceError:
            return None

    def _solved(self, matrix: sp.bsr_matrix, residual: FloatArray) -> FloatArray:
        if time.thread_time() > self._newton_until:
            raise ConvergenceError("Newton's method takes longer than a step may")
        return DynamicSession._solved(self, matrix, residual)
