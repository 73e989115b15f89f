"""Penalties of contact: raised on stiff elements and where bodies penetrate, lowered where soft frictional points defeat Newton's method.

A penalty that is many times the stiffness of an element makes Newton's method fail, one of its order lets bodies penetrate
:cite:p:`wriggers2006`. Both are changed by powers of `FACTOR` only, so that a small change of the materials changes no penalty, and the
derivatives of a solution with respect to its parameters are those at constant penalties.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.hyperelasticity import small_strain_bulk_moduli, small_strain_shear_moduli
from naibu.mechanics.finite_strain.nearby_contact import local_positions
from naibu.mechanics.finite_strain.problem import Problem

FACTOR = 4.0
SOFTEST_NORMAL = 20.0  # Young's moduli (of an incompressible solid) over the edge of an element
STIFFEST_TANGENTIAL = 60.0  # likewise; frictional points that stick more stiffly make iterations alternate between stick and slip
MARGIN = 2.0  # of a penetration, which grows while the load does


def with_suited_penalties(problem: Problem) -> Problem:
    """Return the problem with stiffer normal contact on elements that are stiff themselves."""
    if not problem.contacts:
        return problem
    return problem.with_changes(contacts=stiff_enough(problem.contacts, node_shear_moduli(problem.assembler)))


def stiff_enough(contacts: Sequence[Contact], shear: FloatArray) -> tuple[Contact, ...]:
    """Return contacts with higher normal penalties where they are too soft for the shear moduli (n,), kPa, of the nodes' elements."""
    return tuple(_stiff_enough(c, shear) for c in contacts)


def with_softer_sticking(problem: Problem) -> Problem | None:
    """Return the problem with softer sticking of frictional points on soft elements; None where no point is softened."""
    if not problem.contacts:
        return None
    shear = node_shear_moduli(problem.assembler)
    contacts = tuple(_sticking_softly(c, shear) for c in problem.contacts)
    changed = any(new is not old for new, old in zip(contacts, problem.contacts, strict=True))
    return problem.with_changes(contacts=contacts) if changed else None


def node_shear_moduli(assembler: Assembler) -> FloatArray:
    """Return the smallest shear modulus (n,), kPa, of the elements at every node."""
    return _least(assembler, small_strain_shear_moduli(assembler.law_codes, assembler.parameters))


def node_bulk_moduli(assembler: Assembler) -> FloatArray:
    """Return the smallest bulk modulus (n,), kPa, of the elements at every node."""
    return _least(assembler, small_strain_bulk_moduli(assembler.law_codes, assembler.parameters))


def _least(assembler: Assembler, cells: FloatArray) -> FloatArray:
    """Return the smallest value (n,) of the groups at every node, of values (m,) of the cells."""
    of_group = cells[assembler.elements.cell_of_point[:, 0]]
    out = np.full(assembler.elements.n_points, np.inf)
    np.minimum.at(out, assembler.elements.connectivity, of_group[:, None])
    return out


def _stiff_enough(contact: Contact, shear: FloatArray) -> Contact:
    wanted = SOFTEST_NORMAL * _stiffness(contact, shear) / contact.normal_stiffness
    if not (wanted > 1.0).any():
        return contact
    return replace(contact, normal_stiffness=_power(np.maximum(wanted, 1.0), up=True) * contact.normal_stiffness)


def _sticking_softly(contact: Contact, shear: FloatArray) -> Contact:
    wanted = STIFFEST_TANGENTIAL * _stiffness(contact, shear) / contact.tangential_stiffness
    rubs = (contact.friction_coefficient < STICK) & (not contact.tied)  # others are springs, or meant to stick
    if not (wanted[rubs] < 1.0).any():
        return contact
    softer = np.where(rubs, _power(np.minimum(wanted, 1.0)), 1.0)
    return replace(contact, tangential_stiffness=softer * contact.tangential_stiffness)


def _stiffness(contact: Contact, shear: FloatArray) -> FloatArray:
    """Return Young's modulus over the edge of the element (p,), kPa/mm, of the stiffer element of every point, if incompressible."""
    return np.asarray(3.0 * shear[contact.nodes].max(axis=1) / contact.element_size)


def _power(factor: FloatArray, *, up: bool = False) -> FloatArray:
    """Return the next power of FACTOR."""
    exponent = np.log(factor) / np.log(FACTOR)
    return np.asarray(FACTOR ** (np.ceil(exponent - 1e-9) if up else np.floor(exponent + 1e-9)))


def relative_penetrations(contacts: Sequence[Contact], displacement: FloatArray, load: float) -> list[FloatArray]:
    """Return how deeply bodies penetrate at every point (p,) of every contact, as a fraction of the edge of the element there."""
    return [-local_positions(c, displacement, load)[1] / c.element_size for c in contacts]


def stiffened(problem: Problem, depths: Sequence[FloatArray], allowed: float) -> Problem:
    """Return the problem with higher normal penalties of the points that are penetrated by `depths` and more than allowed, or nearly so."""
    contacts = tuple(
        replace(c, normal_stiffness=np.where(depth * MARGIN > allowed, FACTOR, 1.0) * c.normal_stiffness)
        for c, depth in zip(problem.contacts, depths, strict=True)
    )
    return problem.with_changes(contacts=contacts)


def with_less_penetration(contacts: Sequence[Contact], depths: Sequence[FloatArray], allowed: float) -> tuple[Contact, ...] | None:
    """Return contacts with higher normal penalties where `depths` (p,) exceed what is allowed; None where they do not."""
    if not any((depth > allowed).any() for depth in depths):
        return None
    return tuple(
        replace(c, normal_stiffness=np.where(depth > allowed, FACTOR, 1.0) * c.normal_stiffness)
        for c, depth in zip(contacts, depths, strict=True)
    )


def with_normal_stiffness(problem: Problem, normal_stiffness: Sequence[FloatArray]) -> Problem:
    """Return the problem with these normal penalties of the points (p,) of every contact, kPa/mm; with its own where there are none."""
    if not normal_stiffness:
        return problem
    pairs = zip(problem.contacts, normal_stiffness, strict=True)
    return problem.with_changes(contacts=tuple(replace(c, normal_stiffness=penalty) for c, penalty in pairs))
