"""Where the readings of a fingertip are not in proportion to the force: geometry, contact and law, each turned off by itself.

Geometry and law are turned off together by small strains (the law ``linear_elastic``), the law alone by another one, and the contact by
the rod's final traction as a dead load, which grows in proportion. With all of them off the readings are in proportion to the force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import FingertipModel, Press
from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import LoadState, solve

LINEAR_LAW, OTHER_LAW = "linear_elastic", "saint_venant_kirchhoff"
_SETTINGS = SolverSettings(first_step=1.0, largest_step=1.0, tolerance=1e-6)
_PARTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class SwitchedPress:
    """Loads on the chip in a model of which something is turned off.

    Attributes
    ----------
    name : str
        What counts.
    force_mn : ndarray, shape (n,)
        Size of the force on the fingertip, from 0, mN.
    chip_loads : ndarray, shape (n, 6)
        F_x, F_y, F_z, M_x, M_y, M_z on the chip, mN and mN mm.
    """

    name: str
    force_mn: FloatArray
    chip_loads: FloatArray

    def bow(self, load: int) -> float:
        """Return how far one of the six loads departs from proportion to the force, at most, over its largest value."""
        return _bow(self.force_mn, self.chip_loads[:, load])

    @property
    def ratio_bow(self) -> float:
        """How far M_y departs from proportion to F_x, at most, over its largest value."""
        return _bow(self.chip_loads[:, 0], self.chip_loads[:, 4])


def _bow(x: FloatArray, y: FloatArray) -> float:
    straight = y[-1] * x / x[-1]
    return float(np.abs(y - straight).max() / np.abs(y[-1]))


def switched_presses(fingertip: Fingertip, press: Press, resolution: FingertipResolution | None = None) -> tuple[SwitchedPress, ...]:
    """Press a fingertip by models in which geometry, contact and law are turned off in turn.

    Parameters
    ----------
    fingertip : Fingertip
        With a hyperelastic law.
    press : Press
        What presses it.
    resolution : FingertipResolution, optional
        Of the mesh.

    Returns
    -------
    tuple of SwitchedPress
        All effects; the other law; small strains; the rod's traction as a dead load; and that at small strains.

    Raises
    ------
    ConvergenceError
        No equilibrium was found.
    """
    out, models = [], {}
    for law, name in ((fingertip.law, "all"), (OTHER_LAW, "another law"), (LINEAR_LAW, "contact only (small strains)")):
        models[law] = FingertipModel.of(replace(fingertip, law=law), resolution)
        pressing = models[law].pressed(press, keep_displacement=law == fingertip.law)
        out.append(SwitchedPress(name, np.linalg.norm(pressing.force_mn, axis=1), pressing.chip_loads))
        if law == fingertip.law:
            traction = _traction(models[law], pressing.displacement_mm[-1])
    for law, name in ((fingertip.law, "geometry and law (dead load)"), (LINEAR_LAW, "none (dead load, small strains)")):
        out.append(_dead_load(models[law], traction, name))
    return tuple(out)


def _traction(model: FingertipModel, displacement: FloatArray) -> FloatArray:
    """Return the forces of the rod on the nodes (n, 3), mN: what balances the gel where nothing else holds it."""
    force = model.assembler.forces(displacement)[1]
    force[model.support.constrained] = 0.0
    touched = np.zeros(len(force), dtype=bool)
    touched[np.unique(model.faces)] = True
    return np.asarray(np.where(touched[:, None], force, 0.0))


def _dead_load(model: FingertipModel, traction: FloatArray, name: str) -> SwitchedPress:
    force, loads, start = [np.zeros(3)], [np.zeros(6)], None
    points = model.mesh.points
    for part in range(1, _PARTS + 1):
        problem = Problem(points, model.assembler, (), model.support, part / _PARTS * traction)
        state = solve(problem, settings=_SETTINGS, start=start).states[-1]
        start = LoadState(0.0, state.displacement, ())
        whole, on_chip, moment = model.loads(state.displacement)
        force.append(whole)
        loads.append(np.concatenate([on_chip, moment]))
    return SwitchedPress(name, np.linalg.norm(np.array(force), axis=1), np.array(loads))
