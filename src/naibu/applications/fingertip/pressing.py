"""A rod that presses a fingertip: finite strain statics with unilateral contact and friction, and the load on the chip's package.

The rod's flat end is perpendicular to its axis, which points to the centre of the hemisphere, tilted from the base's normal. By symmetry
half of the fingertip is computed, in the plane of the tilt. Stresses in the gel are in proportion to its Young's modulus at the same
shape, so that a run holds for every modulus (`Pressing.for_modulus`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from naibu.applications.fingertip.fingertip import PACKAGE, Fingertip, FingertipResolution, fingertip_mesh
from naibu.core.arrays import FloatArray, IntArray, require_positive, require_within
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import LoadState, solve
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.surface import boundary_faces

MOST_TILT_DEG = 45.0  # contact must stay on the hemisphere
DEEPEST = 0.45  # of the radius
_SETTINGS = SolverSettings(first_step=0.12, largest_step=0.2, tolerance=1e-6)
_STICKING_KPA_PER_MM = 50.0  # before slip, at the gel of the report
_NORMAL_KPA_PER_MM = 1000.0
_REPORTED_KPA = 220.0
_MOST_PARTS = 12
_OVERSHOOT = 0.01  # of the force
_ON_SURFACE = 1e-6  # mm
_DECIMALS = 9  # of loads, mN: less is rounding


@dataclass(frozen=True, slots=True)
class Press:
    """A press with the flat end of a rod.

    Attributes
    ----------
    tilt_deg : float
        theta: angle between the rod's axis and the base's normal, degrees, at most 45.
    force_mn : float
        Largest force along the rod, mN.
    friction : float
        Coulomb's coefficient between rod and gel.
    slide_mm : float
        How far the rod then slides across its axis, away from the base's normal, mm.

    Raises
    ------
    InputError
        An angle, force or coefficient beyond its range.
    """

    tilt_deg: float
    force_mn: float
    friction: float = 0.5
    slide_mm: float = 0.0

    def __post_init__(self) -> None:
        require_within("tilt_deg", self.tilt_deg, 0.0, MOST_TILT_DEG, "degrees")
        require_positive("force_mn", self.force_mn, "mN")
        require_within("friction", self.friction, 0.0, 5.0)
        require_within("slide_mm", self.slide_mm, -1e3, 1e3, "mm")

    @property
    def axis(self) -> FloatArray:
        """Unit vector (3,) from the hemisphere's centre along the rod, in the plane y = 0."""
        theta = np.deg2rad(self.tilt_deg)
        return np.array([np.sin(theta), 0.0, np.cos(theta)])


@dataclass(frozen=True, slots=True, eq=False)
class Pressing:
    """What a press did, in the order of the equilibrium states, with the tilt in the plane y = 0 towards x.

    Attributes
    ----------
    press : Press
        The press.
    young_modulus_kpa : float
        Of the gel.
    depth_mm : ndarray, shape (n,)
        How far the rod moved along its axis.
    slide_mm : ndarray, shape (n,)
        How far it moved across.
    force_mn : ndarray, shape (n, 3)
        Force of the rod on the fingertip.
    chip_mn : ndarray, shape (n, 3)
        Force on the chip through its package: F_x, F_y, and F_z, which is positive where it presses the chip down.
    chip_mn_mm : ndarray, shape (n, 3)
        Moments M_x, M_y, M_z on the chip about the centre of the base.
    contact_mm : ndarray, shape (n, 3)
        Centre of the contact's pressure, NaN without contact.
    contact_radius_mm : ndarray, shape (n,)
        Radius of the contact: that of a Hertzian one with the same second moment of the pressure.
    displacement_mm : ndarray, shape (n, nodes, 3)
        Of the nodes of the mesh; empty where it was not kept.
    """

    press: Press
    young_modulus_kpa: float
    depth_mm: FloatArray
    slide_mm: FloatArray
    force_mn: FloatArray
    chip_mn: FloatArray
    chip_mn_mm: FloatArray
    contact_mm: FloatArray
    contact_radius_mm: FloatArray
    displacement_mm: FloatArray

    @property
    def along_rod_mn(self) -> FloatArray:
        """Force along the rod (n,), mN."""
        return np.asarray(-self.force_mn @ self.press.axis)

    @property
    def chip_loads(self) -> FloatArray:
        """F_x, F_y, F_z, M_x, M_y, M_z on the chip (n, 6), mN and mN mm."""
        return np.concatenate([self.chip_mn, self.chip_mn_mm], axis=1)

    def at_force(self, force_mn: FloatArray) -> FloatArray:
        """Return the loads (k, 6) on the chip, mN and mN mm, at forces (k,) along the rod while it is pressed in, mN."""
        return self.interpolated(self.chip_loads, force_mn)

    def interpolated(self, values: FloatArray, force_mn: FloatArray) -> FloatArray:
        """Return values (n, ...) of the states, interpolated to forces (k,) along the rod while it is pressed in, mN: (k, ...)."""
        return np.asarray(self._while_pressed(values)(force_mn))

    def _while_pressed(self, values: FloatArray) -> PchipInterpolator:
        force = np.maximum.accumulate(self.along_rod_mn)
        first = np.concatenate([[True], np.diff(force) > 0.0]) & (self.slide_mm == 0.0)
        return PchipInterpolator(force[first], values[first], axis=0)

    def for_modulus(self, young_modulus_kpa: float) -> Pressing:
        """Return the press of a gel with another Young's modulus, kPa, and else the same: forces and moments are in proportion to it."""
        ratio = require_positive("young_modulus_kpa", young_modulus_kpa, "kPa") / self.young_modulus_kpa
        return replace(
            self,
            press=replace(self.press, force_mn=ratio * self.press.force_mn),
            young_modulus_kpa=young_modulus_kpa,
            force_mn=ratio * self.force_mn,
            chip_mn=ratio * self.chip_mn,
            chip_mn_mm=ratio * self.chip_mn_mm,
        )


def rotated_loads(loads: FloatArray, azimuth_deg: float) -> FloatArray:
    """Return loads (n, 6) of a press whose tilt is towards `azimuth_deg` from x towards y, from those of a tilt towards x."""
    phi = np.deg2rad(azimuth_deg)
    c, s = np.cos(phi), np.sin(phi)
    turn = np.array([[c, -s], [s, c]])
    turned = np.array(loads, dtype=float)
    turned[:, 0:2], turned[:, 3:5] = loads[:, 0:2] @ turn.T, loads[:, 3:5] @ turn.T
    return np.asarray(np.round(turned, _DECIMALS) + 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class FingertipModel:
    """A fingertip as finite elements, which rods press.

    Attributes
    ----------
    fingertip : Fingertip
        Dimensions and materials.
    mesh : Mesh
        Of its half with y >= 0.
    faces : ndarray, shape (f, 4), int64
        Faces of the hemisphere, which may be touched.
    base : ndarray, shape (k,), int64
        Nodes that are bonded to the base.
    assembler, package : Assembler
        All elements, and the same with those of the gel made void.
    """

    fingertip: Fingertip
    mesh: Mesh
    faces: IntArray
    base: IntArray
    assembler: Assembler
    package: Assembler

    @classmethod
    def of(cls, fingertip: Fingertip, resolution: FingertipResolution | None = None) -> FingertipModel:
        """Mesh a fingertip."""
        mesh = fingertip_mesh(fingertip, resolution)
        outer = boundary_faces(mesh).faces
        faces = outer[(np.linalg.norm(mesh.points[outer], axis=2) > fingertip.radius_mm - _ON_SURFACE).all(axis=1)]
        parts = elements(mesh)
        pattern = block_pattern(mesh.n_points, parts.connectivity, faces)
        assembler = Assembler.from_materials(parts, mesh.regions, list(fingertip.materials), pattern)
        void = np.where((mesh.regions == PACKAGE)[:, None], assembler.parameters, 0.0)
        base = np.flatnonzero(mesh.points[:, 2] == 0.0)
        return cls(fingertip, mesh, faces, base, assembler, assembler.with_parameters(void))

    @property
    def support(self) -> PrescribedDisplacement:
        """The base is fixed, the plane of symmetry stays plane."""
        fixed = PrescribedDisplacement.none(self.mesh.n_points).and_also(self.base, np.zeros(3))
        return fixed.and_also(np.flatnonzero(self.mesh.points[:, 1] == 0.0), np.zeros(3), (False, True, False))

    def loads(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the force on the fingertip, and force and moment on the chip, each (3,), mN and mN mm, at a displacement (n, 3), mm.

        Those of the whole fingertip: twice those of its half, or none across the plane of symmetry. F_z on the chip is positive downwards.
        """
        whole = self.assembler.forces(displacement)[1][self.base].sum(axis=0)
        on_chip = -self.package.forces(displacement)[1][self.base]
        moment = np.cross(self.mesh.points[self.base], on_chip).sum(axis=0)
        return np.array([-2.0, 0.0, -2.0]) * whole, np.array([2.0, 0.0, -2.0]) * on_chip.sum(axis=0), np.array([0.0, 2.0, 0.0]) * moment

    def pressed(
        self, press: Press, *, keep_displacement: bool = False, settings: SolverSettings | None = None,
        callback: Callable[[float], None] | None = None,
    ) -> Pressing:  # fmt: skip
        """Press the fingertip until the rod's force is reached, then slide.

        Parameters
        ----------
        press : Press
            Tilt, force, friction and slide.
        keep_displacement : bool
            Whether the displacements of all nodes are kept.
        settings : SolverSettings, optional
            Load steps and tolerances.
        callback : callable, optional
            Called after every load step with the fraction of the part of the way, in (0, 1].

        Raises
        ------
        ConvergenceError
            No equilibrium was found.
        InputError
            A force that would need a depth of more than 0.45 radii.
        """
        run = _Run(self, press, settings or _SETTINGS, callback)
        run.press_in()
        if press.slide_mm != 0.0:
            run.slide()
        return run.result(keep_displacement)


class _Run:
    """States of one press; `press_in` and `slide` append to them."""

    def __init__(self, model: FingertipModel, press: Press, settings: SolverSettings, callback: Callable[[float], None] | None) -> None:
        self.model, self.press, self.settings, self.callback = model, press, settings, callback
        self.rows: list[tuple[float, float, FloatArray, FloatArray, FloatArray, FloatArray, float]] = []
        self.states: list[LoadState] = []

    def contact(self, depth: float, to_depth: float, across: float, to_across: float) -> Contact:
        """Contact with the rod's end plane, which moves between two positions."""
        axis, tip = self.press.axis, self.model.fingertip
        outwards = np.array([axis[2], 0.0, -axis[0]])
        stiffer = tip.young_modulus_kpa / _REPORTED_KPA * 20.0 / tip.diameter_mm
        return rigid_contact(
            "rod", self.model.mesh.points, self.model.faces, plane_geometry(-axis),
            start=axis * (tip.radius_mm - depth) + across * outwards, stop=axis * (tip.radius_mm - to_depth) + to_across * outwards,
            friction=Friction(self.press.friction, _STICKING_KPA_PER_MM * stiffer), normal_stiffness=_NORMAL_KPA_PER_MM * stiffer,
        )  # fmt: skip

    def press_in(self) -> None:
        """Move the rod along its axis until its force is reached."""
        radius, wanted = self.model.fingertip.radius_mm, self.press.force_mn
        depth, ahead = 0.0, min(1.05 * estimated_depth(self.model.fingertip, wanted), DEEPEST * radius)
        for _ in range(_MOST_PARTS):
            self._move(depth, ahead, 0.0, 0.0)
            depth, reached = ahead, self._along_rod()
            if reached >= wanted:
                self._back_to(wanted)
                return
            if depth >= DEEPEST * radius:
                raise InputError(
                    f"force_mn is {wanted:g}: at a depth of {depth:.3g} mm, {100 * DEEPEST:g} % of the radius, the rod has reached "
                    f"{reached:.4g} mN; press less, or a larger or stiffer fingertip"
                )
            growth = (1.1 * wanted / max(reached, 0.05 * wanted)) ** 0.6
            ahead = min(depth * float(np.clip(growth, 1.03, 1.5)), DEEPEST * radius)
        raise ConvergenceError(f"the rod did not reach {wanted:g} mN in {_MOST_PARTS} parts of its way")

    def _back_to(self, wanted: float) -> None:
        """Replace the states beyond a force along the rod, mN, by one just above it."""
        force = np.maximum.accumulate([-row[2] @ self.press.axis for row in self.rows])
        rising = np.concatenate([[True], np.diff(force) > 0.0])
        depth = np.array([row[0] for row in self.rows])
        if force[-1] > (1.0 + _OVERSHOOT) * wanted:
            to_depth = float(PchipInterpolator(force[rising], depth[rising])((1.0 + 0.4 * _OVERSHOOT) * wanted))
            kept = int(np.flatnonzero(depth < to_depth)[-1]) + 1
            del self.rows[kept:], self.states[kept:]
            short = replace(self.settings, first_step=1.0, largest_step=1.0)
            self._move(float(depth[kept - 1]), to_depth, 0.0, 0.0, short)

    def slide(self) -> None:
        """Move the rod across its axis, at the depth that it has reached."""
        self._move(self.rows[-1][0], self.rows[-1][0], 0.0, self.press.slide_mm)

    def _move(self, depth: float, to_depth: float, across: float, to_across: float, settings: SolverSettings | None = None) -> None:
        mesh = self.model.mesh
        contact = self.contact(depth, to_depth, across, to_across)
        start = None
        if self.states:
            last = self.states[-1]
            start = LoadState(0.0, last.displacement, last.anchors)
            contact = replace(contact, normal_stiffness=last.normal_stiffness[0])
        problem = Problem(mesh.points, self.model.assembler, (contact,), self.model.support, np.zeros_like(mesh.points))
        solution = solve(problem, settings=settings or self.settings, start=start, callback=self.callback)
        for k, state in enumerate(solution.states):
            if k or not self.states:
                stiffness = state.normal_stiffness[0] if state.normal_stiffness else contact.normal_stiffness
                self._add(
                    state, depth + state.load * (to_depth - depth), across + state.load * (to_across - across),
                    replace(contact, normal_stiffness=stiffness), solution.states[max(k - 1, 0)].anchors[0],
                )  # fmt: skip

    def _add(self, state: LoadState, depth: float, across: float, contact: Contact, anchors: FloatArray) -> None:
        """Append forces and contact of a state."""
        axis = self.press.axis
        pressed = contact.evaluate(state.displacement, anchors, state.load)
        pressure = np.maximum(pressed.force @ pressed.orientation.T @ -axis, 0.0)
        where = contact.positions(state.displacement)
        centre, radius = np.full(3, np.nan), 0.0
        if pressure.sum() > 0.0:
            centre = (pressure @ where) / pressure.sum() * [1.0, 0.0, 1.0]
            aside = where - centre
            aside -= np.outer(aside @ axis, axis)
            radius = float(np.sqrt(2.5 * (pressure @ (aside**2).sum(axis=1)) / pressure.sum()))
        self.rows.append((depth, across, *self.model.loads(state.displacement), centre, radius))
        self.states.append(state)

    def _along_rod(self) -> float:
        return float(-self.rows[-1][2] @ self.press.axis)

    def result(self, keep_displacement: bool) -> Pressing:
        """Return the press."""
        depth, across, force, on_chip, moment, centre, radius = (np.array(column) for column in zip(*self.rows, strict=True))
        moved = np.stack([s.displacement for s in self.states]) if keep_displacement else np.zeros((len(depth), 0, 3))
        modulus = self.model.fingertip.young_modulus_kpa
        return Pressing(self.press, modulus, depth, across, force, on_chip, moment, centre, radius, moved)


def estimated_depth(fingertip: Fingertip, force_mn: float) -> float:
    """Return about the depth, mm, at which a rod presses with a force, mN: Hertz's, less what the bonded base stiffens."""
    radius, plane_modulus = fingertip.radius_mm, fingertip.young_modulus_kpa / (1.0 - fingertip.poisson_ratio**2)

    def excess(x: float) -> float:
        return float(4.0 / 3.0 * plane_modulus * radius**2 * x**1.5 * (1.0 + 2.2 * x + 6.0 * x**2) - force_mn)

    return radius * (1.0 if excess(1.0) < 0.0 else float(brentq(excess, 0.0, 1.0)))
