"""A cut that a thread prepares, with the factors of the body behind it, while the body goes on moving."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from naibu.core.errors import NaibuError
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicState
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.simulation.interactive_bodies import FiniteElementBody


@dataclass(slots=True, eq=False)
class BackgroundCut:
    """A cut under way.

    Attributes
    ----------
    body : FiniteElementBody
        What is cut.
    """

    body: FiniteElementBody
    _made: tuple[FiniteElementBody, VolumeCut] | None = field(init=False, default=None)
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
        body, found = self._made
        return body, DynamicState(found.nodal(state.displacement), found.nodal(state.velocity))

    def wait(self) -> None:
        """Wait for the thread."""
        if self._thread is not None:
            self._thread.join()

    def _run(self, state: DynamicState, blade: SweptBlade, distance_mm: float | None) -> None:
        try:
            body, _, found = self.body.cut(state, blade, distance_mm)
            session = body.session()
            with suppress(NaibuError):  # whoever steps it next is told
                session.step(body.grip_velocity(np.zeros(3)), [])  # its factors serve the sessions that follow
            session.close()
            self._made = body, found
        except BaseException as error:
            self._failure = error
