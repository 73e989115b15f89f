"""Assembly with the contact of the two sides of cuts, which internal forces and tangent contain."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact.cut_lips import CutLips, cut_lips
from naibu.mechanics.contact.step_ties import StepTies, step_ties
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.penalties import node_bulk_moduli, node_shear_moduli


@dataclass(frozen=True, slots=True, eq=False)
class LipAssembler(Assembler):
    """An assembler whose forces and tangent contain the contact of the sides of cuts.

    Attributes
    ----------
    lips : CutLips, optional
        Pairs of nodes on both sides.
    secant : bool
        Whether the tangent contains the secant of friction instead of its derivative, and is symmetric then.
    ties : StepTies, optional
        Springs between the steps in which their facets follow an oblique blade.
    """

    lips: CutLips | None = None
    secant: bool = False
    ties: StepTies | None = None
    _pairs: Int32Array = field(default_factory=lambda: np.zeros((0, 2, 2), dtype=np.int32))
    _tied: Int32Array | None = None

    def forces_of_parameter(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative (n, 3) of the internal forces along `direction` (m, 4) in the cells' parameters; lips have none."""
        return Assembler._run(self, displacement, direction, np.empty((0, 3, 3)))[1]

    def in_step(self, displacement: FloatArray, lips: FloatArray | None = None) -> LipAssembler:
        """Return the assembler of a time step that begins at a displacement (n, 3), mm: lips have the normals that they have there.

        Those that rub on each other have slipped to the frictional anchors `lips` (p, 3), mm, by default those at rest.
        """
        if self.lips is None:
            return self
        ties = None if self.ties is None or self._tied is None else self.ties.in_step(self.lips, displacement)
        return replace(self, lips=self.lips.with_normals_of(displacement).with_anchors(lips if self.unsymmetric else None), ties=ties)

    @property
    def unsymmetric(self) -> bool:
        """Whether friction of the sides of cuts makes the tangent unsymmetric."""
        return self.lips is not None and self.lips.friction > 0.0

    def add_contact_of_lips(self, displacement: FloatArray, force: FloatArray) -> None:
        """Add the forces of lips in contact to internal forces (n, 3), mN."""
        if self.lips is not None:
            self.lips.add(displacement, force)
            if self.ties is not None:
                self.ties.add(self.lips, displacement, force, np.empty((0, 0, 0), np.int32), np.empty((0, 3, 3)))

    def _run(self, displacement: FloatArray, parameters: FloatArray, blocks: FloatArray) -> tuple[float, FloatArray, float]:
        energy, force, smallest = Assembler._run(self, displacement, parameters, blocks)
        if self.lips is None:
            return energy, force, smallest
        more, stiffness = self.lips.add(displacement, force, secant=self.secant)
        if len(blocks):
            for a in range(2):
                for b in range(2):
                    np.add.at(blocks, self._pairs[:, a, b], stiffness if a == b else -stiffness)
        if self.ties is not None and self._tied is not None:
            more += self.ties.add(self.lips, displacement, force, self._tied, blocks)
        return energy + more, force, smallest


def lips_of(assembler: Assembler) -> tuple[CutLips, ...]:
    """Return the sides of the cuts of an assembler; of one that has none, nothing."""
    return (assembler.lips,) if isinstance(assembler, LipAssembler) and assembler.lips is not None else ()


@dataclass(frozen=True, slots=True, eq=False)
class LipMultipliers:
    """What the sides of cuts exert at the beginning of a time step: the multipliers of an augmented Lagrangian :cite:p:`wriggers2006`.

    Attributes
    ----------
    overlaps : ndarray, shape (p,), optional
        See `naibu.mechanics.contact.cut_lips.CutLips`.
    tensions : ndarray, shape (m,), optional
        See `naibu.mechanics.contact.step_ties.StepTies`.
    """

    overlaps: FloatArray | None
    tensions: FloatArray | None


def with_multipliers(assembler: Assembler, multipliers: LipMultipliers | None) -> Assembler:
    """Return the assembler whose sides of cuts exert this at the beginning of a step; None: nothing."""
    if multipliers is None or not isinstance(assembler, LipAssembler) or assembler.lips is None:
        return assembler
    ties = None if assembler.ties is None else assembler.ties.with_tensions(multipliers.tensions)
    return replace(assembler, lips=assembler.lips.with_overlaps(multipliers.overlaps), ties=ties)


def multipliers_behind(assembler: Assembler, displacement: FloatArray) -> LipMultipliers | None:
    """Return with what the sides of cuts go on from a displacement (n, 3), mm, at the end of a step; None where penalties suffice."""
    if not isinstance(assembler, LipAssembler) or assembler.lips is None or not (assembler.lips.yields or assembler.ties is not None):
        return None
    overlaps = assembler.lips.overlaps_behind(displacement) if assembler.lips.yields else None
    return LipMultipliers(overlaps, None if assembler.ties is None else assembler.ties.tensions_behind(assembler.lips, displacement))


def going_on(assembler: Assembler, anchors: FloatArray | None) -> Assembler:
    """Return the assembler whose sides of cuts, where they rub on each other, have slipped to anchors (p, 3), mm; None: those at rest."""
    if not isinstance(assembler, LipAssembler) or assembler.lips is None or not assembler.unsymmetric:
        return assembler
    return replace(assembler, lips=assembler.lips.with_anchors(anchors))


def with_secant(assembler: Assembler, anchors: FloatArray | None) -> Assembler:
    """Return the assembler with a symmetric tangent, of sides of cuts that have slipped to anchors (p, 3), mm; None: those at rest."""
    moved = going_on(assembler, anchors)
    return replace(moved, secant=True) if isinstance(moved, LipAssembler) else moved


def with_unyielding_lips(assembler: Assembler) -> Assembler:
    """Return the assembler whose sides of cuts, and ties, have their largest penalties; the same where there is no cut."""
    if not isinstance(assembler, LipAssembler) or assembler.lips is None:
        return assembler
    return replace(assembler, lips=assembler.lips.unyielding(), ties=None if assembler.ties is None else assembler.ties.unyielding())


def with_friction(assembler: Assembler, coefficient: float) -> Assembler:
    """Return an assembler whose sides of cuts rub on each other; the same where there is no cut.

    Raises
    ------
    InputError
        A negative coefficient, or NaN.
    """
    if not isinstance(assembler, LipAssembler) or assembler.lips is None:
        return assembler
    return replace(assembler, lips=assembler.lips.with_friction(coefficient))


def with_lips(
    assembler: Assembler, points: FloatArray, faces: IntArray, friction: float = 0.0,
    cells: IntArray | None = None, outward: FloatArray | None = None,
) -> Assembler:  # fmt: skip
    """Return an assembler in which the two sides of cuts do not pass through each other; the same where there is no cut.

    Parameters
    ----------
    assembler : Assembler
        Of a mesh in which cuts have doubled nodes.
    points : ndarray, shape (n, 3)
        Its nodes in the reference configuration, mm.
    faces : ndarray, shape (f, 3), int64
        Its boundary triangles; those that lie on each other are the sides of cuts. Quadrilaterals have no such contact.
    friction : float
        Coulomb's coefficient between the two sides.
    cells : ndarray, shape (m, 4), int64, optional
        Tetrahedra, which carry the normals of blades.
    outward : ndarray, shape (n, 3), optional
        Of nodes on a side of a cut, the normal of the blade in the reference configuration, outwards; zero where it is not known. By
        default the sides have the normals of their facets.

    Raises
    ------
    InputError
        A negative coefficient.
    """
    if faces.shape[1] != 3:
        return assembler
    lips = cut_lips(points, faces, (node_shear_moduli(assembler), node_bulk_moduli(assembler)), cells, outward)
    if lips is None:
        return assembler
    lips = lips.with_friction(friction)
    ties = step_ties(lips)
    coupled = assembler.with_couplings(lips.pairs, *(() if ties is None else (ties.nodes,)))
    known = {f.name: getattr(coupled, f.name) for f in fields(Assembler)}
    tied = None if ties is None else coupled.pattern.positions(ties.nodes)
    return LipAssembler(**known, lips=lips, ties=ties, _pairs=coupled.pattern.positions(lips.pairs), _tied=tied)
