"""Unknown parameters of a lattice study: K, C1, C2 of groups of elements, friction and pull-off of its bodies, mass of its surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.unknowns import KINDS, UNITS, require_positive_values
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.model.lattice import CLASSES, ZONES, Lattice, LatticeParameters
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy
from naibu.mechanics.lattices.simulation.tangent_linear import ParameterChange

Groups = Literal["class", "zone", "class and zone", "all", "given"]
Friction = Literal["given", "common", "each"]

FRICTION = (0.01, 0.99)  # range of the report :cite:p:`hirai2008`
FRICTION_START = {"static_friction": 0.5, "kinetic_friction": 0.4}  # of bodies whose friction is stated to be 0
PULL_OFF = {"pull_stiffness": "mN/mm", "pull_damping": "mN s/mm", "pull_speed": "mm/s"}
SURFACE_MASS = "mass of a surface node over that of a core node"
# of a logarithm, for differences where no tangent is integrated: above what the solver leaves, below the curvature. In
# contact what jumps counts as information the more, the shorter they are (benchmarks/lattice_calibration.py --differences)
SHIFT = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What a study is simulated with: parameters of the elements, indenters with their friction, and masses of the nodes, kg (n,)."""

    parameters: LatticeParameters
    indenters: tuple[RigidIndenter, ...]
    node_mass: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrialChange:
    """A direction in which a trial changes.

    Attributes
    ----------
    moved : Trial
        The trial with one logarithm larger by `shift`, for differences.
    shift : float
        Plus or minus `SHIFT`.
    tangent : ParameterChange, optional
        Derivative of the elements' parameters by that logarithm; None of what is no parameter of the elements.
    """

    moved: Trial
    shift: float
    tangent: ParameterChange | None


@dataclass(frozen=True, slots=True, eq=False)
class StudyUnknowns:
    """Named parameters of a study, all positive.

    Attributes
    ----------
    names : tuple of str
        ``"K short"``, ``"kinetic friction of floor"`` and so on.
    units : tuple of str
        Of the values.
    start : ndarray, shape (p,)
        Values that the study states.
    bounds : ndarray, shape (p, 2)
        Between which values are simulated.
    study : LatticeStudy
        What everything else is taken from.
    kind, members : tuple of int, ndarray of shape (q, m)
        0 K, 1 C1, 2 C2 of the first q parameters, and the elements that have them.
    surfaces : tuple of (str, tuple of int)
        Quantity and bodies of the next parameters.
    masses : bool
        Whether the last one is the ratio of surface to core masses.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: FloatArray
    bounds: FloatArray
    study: LatticeStudy
    kind: tuple[int, ...]
    members: BoolArray
    surfaces: tuple[tuple[str, tuple[int, ...]], ...]
    masses: bool

    @classmethod
    def of(
        cls,
        study: LatticeStudy,
        *,
        groups: Groups = "class",
        friction: Friction = "given",
        pull_off: bool = False,
        surface_mass: bool = False,
    ) -> StudyUnknowns:
        """Name the unknown parameters of a study; all others keep the values that it states.

        Parameters
        ----------
        study : LatticeStudy
            With rough values, from which a search starts. K and C1 of 0, and C2 of infinity, stay so.
        groups : str
            Elements that share K, C1 and C2: those of a ``"class"``, of a ``"zone"``, of both, or ``"all"``; ``"given"``: none is unknown.
        friction : str
            ``"common"`` for two coefficients of all bodies in contact, ``"each"`` for two of every body, or ``"given"``.
        pull_off : bool
            Whether stiffness, damping and speed of the pull-off are unknown where the study states any, the same for all bodies.
        surface_mass : bool
            Whether masses at the surface may differ from those of the core; the total stays.

        Raises
        ------
        InputError
            Nothing is unknown, or friction or pull-off of bodies that are tied or have none, or an unknown choice.
        """
        for name, value, known in (("groups", groups, get_args(Groups)), ("friction", friction, get_args(Friction))):
            if value not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}, not {value!r}")
        kinds, members, labels, values = _element_groups(study, groups)
        units = [UNITS[KINDS[kind]] for kind in kinds]
        bounds = [(1e-9, 1e9)] * len(kinds)
        surfaces = [*_friction(study, friction), *(_pull_off(study) if pull_off else ())]
        for quantity, bodies in surfaces:
            labels.append(_surface_name(study, quantity, bodies, alone=friction != "each" or quantity in PULL_OFF))
            units.append(PULL_OFF.get(quantity, ""))
            stated = float(np.mean([getattr(study.bodies[k].indenter, quantity) for k in bodies]))
            values.append(stated if quantity in PULL_OFF else np.clip(stated or FRICTION_START[quantity], *FRICTION))
            bounds.append((1e-9, 1e9) if quantity in PULL_OFF else FRICTION)
        if surface_mass:
            labels, units, values, bounds = (
                [*labels, SURFACE_MASS],
                [*units, ""],
                [*values, _mass_ratio(study.lattice)],
                [*bounds, (0.01, 100.0)],
            )
        if not labels:
            raise InputError(
                "nothing is unknown: choose groups other than 'given', or friction, pull-off or surface masses to be identified"
            )
        return cls(
            tuple(labels), tuple(units), np.array(values, dtype=float), np.array(bounds), study, tuple(kinds),
            np.array(members, dtype=bool).reshape(len(kinds), study.lattice.n_elements), tuple(surfaces), surface_mass,
        )  # fmt: skip

    def vector(self, values: ArrayLike | Mapping[str, float]) -> FloatArray:
        """Return values (p,) in the order of the names, from numbers, or from a mapping by name that leaves out what stays at its start.

        Raises
        ------
        InputError
            An unknown name, another number of values, or one that is not positive and finite.
        """
        if isinstance(values, Mapping):
            unknown = next((key for key in values if key not in self.names), None)
            if unknown is not None:
                raise InputError(f"there is no parameter {unknown!r}; there are {', '.join(self.names)}")
            found = np.array([values.get(name, own) for name, own in zip(self.names, self.start, strict=True)], dtype=float)
        else:
            found = np.array(values, dtype=float)
        if found.shape != (len(self.names),):
            raise InputError(f"values have shape {found.shape}, but there are {len(self.names)} parameters: {', '.join(self.names)}")
        return require_positive_values(self.names, found)

    def parameters(self, values: FloatArray) -> Trial:
        """Return what is simulated with values (p,), as far as they are `held`."""
        held = self.held(values)
        given, scale = self.study.parameters, self.study.lattice.scale
        tables = [given.stiffness.copy(), given.voigt_damping.copy(), given.series_damping.copy()]
        for kind, mine, value in zip(self.kind, self.members, held, strict=False):
            tables[kind][mine] = value * scale[mine]
        indenters = [body.indenter for body in self.study.bodies]
        for (quantity, bodies), value in zip(self.surfaces, held[len(self.kind) :], strict=False):
            for k in bodies:
                indenters[k] = _with(indenters[k], quantity, float(value))
        mass = self.study.lattice.node_mass
        if self.masses:
            mass = _masses(self.study.lattice, float(held[-1]))
        return Trial(LatticeParameters(tables[0], tables[1], tables[2], given.voigt_fraction), tuple(indenters), mass)

    def changes(self, values: FloatArray) -> tuple[TrialChange, ...]:
        """Return the directions of the logarithms of all values."""
        held, scale, shifts = self.held(values), self.study.lattice.scale, self.shifts(values)
        zero, result = np.zeros(len(scale)), []
        for k in range(len(values)):
            moved = held.copy()
            moved[k] *= np.exp(shifts[k])
            tangent = None
            if k < len(self.kind):
                own = np.where(self.members[k], held[k] * scale, 0.0)
                tangent = ParameterChange(*(own if self.kind[k] == kind else zero for kind in range(3)))
            result.append(TrialChange(self.parameters(moved), float(shifts[k]), tangent))
        return tuple(result)

    def held(self, values: FloatArray) -> FloatArray:
        """Return values (p,) within their bounds, static friction not below kinetic friction.

        Kinetic friction follows from the force while something slides, static friction from how it begins to: the latter gives way.
        """
        held = np.clip(values, *self.bounds.T)
        for static, kinetic in self._frictions():
            held[static] = max(held[static], held[kinetic])
        return held

    def shifts(self, values: FloatArray) -> FloatArray:
        """Return by how much logarithms (p,) change for differences: up, but down from an upper bound and from static friction."""
        most = self.bounds[:, 1].copy()
        for static, kinetic in self._frictions():
            most[kinetic] = min(most[kinetic], values[static])
        return np.where(values * np.exp(SHIFT) > most, -SHIFT, SHIFT)

    def _frictions(self) -> list[tuple[int, int]]:
        """Return the places of static and kinetic friction of the same bodies."""
        where = {(quantity, bodies): len(self.kind) + k for k, (quantity, bodies) in enumerate(self.surfaces)}
        return [(place, where["kinetic_friction", bodies]) for (quantity, bodies), place in where.items() if quantity == "static_friction"]


def _element_groups(study: LatticeStudy, groups: Groups) -> tuple[list[int], list[BoolArray], list[str], list[float]]:
    """Return kinds, elements, names and stated values of the unknown parameters of elements."""
    lattice = study.lattice
    parts: list[tuple[str, BoolArray]] = [("", np.ones(lattice.n_elements, dtype=bool))] if groups != "given" else []
    for wanted, codes, labels in (("class", lattice.element_class, CLASSES), ("zone", lattice.element_zone, ZONES)):
        if wanted in groups:
            split = [(f"{name} {label}", mask & (codes == k)) for name, mask in parts for k, label in enumerate(labels)]
            parts = [(name, mask) for name, mask in split if mask.any()]
    kinds, members, names, values = list[int](), list[BoolArray](), list[str](), list[float]()
    stated = (study.parameters.stiffness, study.parameters.voigt_damping, study.parameters.series_damping)
    for kind, table in enumerate(stated):
        for name, mask in parts:
            own = table[mask] / lattice.scale[mask]
            if (np.isfinite(own) & (own > 0.0)).all():
                kinds.append(kind)
                members.append(mask)
                names.append(f"{KINDS[kind]}{name}")
                values.append(float(np.exp(np.log(own).mean())))
    return kinds, members, names, values


def _friction(study: LatticeStudy, friction: Friction) -> list[tuple[str, tuple[int, ...]]]:
    if friction == "given":
        return []
    if study.tied:
        raise InputError(f'friction is {friction!r}, but all bodies of the study are tied: nothing slides; write contact = "friction"')
    every = range(len(study.bodies))
    sets = [tuple(every)] if friction == "common" else [(k,) for k in every]
    return [(quantity, bodies) for bodies in sets for quantity in FRICTION_START]


def _pull_off(study: LatticeStudy) -> list[tuple[str, tuple[int, ...]]]:
    found = []
    for quantity in PULL_OFF:
        bodies = tuple(k for k, body in enumerate(study.bodies) if getattr(body.indenter, quantity) > 0.0)
        if bodies and not study.tied:
            found.append((quantity, bodies))
    if not found:
        raise InputError(
            "pull_off is to be identified, but no body of the study in contact states a pull_stiffness_mN_per_mm; give a rough one"
        )
    return found


def _surface_name(study: LatticeStudy, quantity: str, bodies: Sequence[int], *, alone: bool) -> str:
    name = quantity.replace("_", " ").replace("pull ", "pull-off ")
    return name if alone else f"{name} of {study.bodies[bodies[0]].name}"


def _with(indenter: RigidIndenter, quantity: str, value: float) -> RigidIndenter:
    """Return an indenter with another surface; a static friction below the kinetic one takes that along, and holds it."""
    if quantity == "static_friction":
        return replace(indenter, static_friction=value, kinetic_friction=min(indenter.kinetic_friction, value))
    if quantity == "kinetic_friction":
        return replace(indenter, kinetic_friction=min(value, indenter.static_friction))
    pull_off = {name: getattr(indenter, name) for name in PULL_OFF} | {quantity: value}
    return replace(
        indenter,
        pull_stiffness=pull_off["pull_stiffness"],
        pull_damping=pull_off["pull_damping"],
        pull_speed=pull_off["pull_speed"],
    )


def _mass_ratio(lattice: Lattice) -> float:
    core = lattice.node_mass[~lattice.surface_node]
    if not len(core):
        raise InputError("surface_mass is to be identified, but all nodes of the lattice are at its surface; make spacing_mm less")
    return float(lattice.node_mass[lattice.surface_node].mean() / core.mean())


def _masses(lattice: Lattice, ratio: float) -> FloatArray:
    """Return masses (n,) whose mean at the surface is `ratio` times that of the core, with the same total."""
    factor = np.where(lattice.surface_node, ratio / _mass_ratio(lattice), 1.0)
    mass = lattice.node_mass * factor
    return np.asarray(mass * (lattice.node_mass.sum() / mass.sum()))
