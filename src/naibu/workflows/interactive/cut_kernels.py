"""Kernels that cuts of finite elements need, compiled by cutting a small body, also while another one is touched."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass, field, replace

from naibu.core.errors import NaibuError
from naibu.mechanics.contact.rigid_indenters import plane_indenter
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.meshing.primitives import box
from naibu.simulation.interactive_bodies import FiniteElementBody
from naibu.simulation.interactive_simulation import InteractiveSimulation
from naibu.workflows.interactive.touchable_models import tools_for

SMALL_MM = 20.0  # edge of the body that is cut
PRESSED = 30  # frames in which a tool comes to it and presses it


def compile_for_cuts(lips_friction: float = 0.0) -> None:
    """Compile what cuts of finite elements need, and steps behind them: a small body is cut, sinks on the cut, is pressed, and dropped.

    Parameters
    ----------
    lips_friction : float
        Coulomb's coefficient between the sides of the cut: with friction there are kernels of their own.
    """
    mesh = box((SMALL_MM,) * 3, (2, 2, 2))
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=10.0, poisson_ratio=0.49)]
    )
    table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.5, kinetic_friction=0.5)
    body = FiniteElementBody.of(mesh, assembler, fixtures=(table,), gravity=(0.0, 0.0, -9810.0))
    simulation = InteractiveSimulation(replace(body, lips_friction=lips_friction), tools_for(body))
    try:
        beside = SMALL_MM / 4.0
        height = 0.6 * SMALL_MM
        simulation.cut([[[-beside, y, height], [0.75 * SMALL_MM, y, height]] for y in (-beside, SMALL_MM + beside)])
        simulation.take(next(iter(simulation.tools)))
        simulation.move((0.5 * SMALL_MM, 0.5 * SMALL_MM, SMALL_MM))
        for _ in range(PRESSED):
            simulation.advance()
    finally:
        simulation.close()


@dataclass(slots=True, eq=False)
class CutKernels:
    """A thread that compiles what cuts need, for them not to wait for it when the first one is made.

    Attributes
    ----------
    lips_friction : float
        Coulomb's coefficient between the sides of cuts to come.
    """

    lips_friction: float = 0.0
    _thread: threading.Thread = field(init=False)

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._run, name="naibu cut kernels", daemon=True)
        self._thread.start()

    @property
    def ready(self) -> bool:
        """Whether all is compiled; also where that failed, which the first cut then tells."""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Wait until all is compiled."""
        self._thread.join()

    def _run(self) -> None:
        with suppress(NaibuError):
            compile_for_cuts(self.lips_friction)
