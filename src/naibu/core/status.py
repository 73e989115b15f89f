"""Solver status: how a solve ended, in a sentence for the user."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """Status of a solve; the value is the sentence for the user."""

    CONVERGED = "Converged."
    STEP_TOO_SMALL = (
        "The load step became too small: Newton's method failed even for a tiny increment. The body may buckle, a corner may fold, or the "
        "load is more than the mesh can follow. Refine the mesh near the indenter, lower the load or the Poisson ratio, or ask for "
        "more steps."
    )
    INVERSION = (
        "An element is about to turn inside out: the load compresses or folds it more than the mesh can follow. Refine the mesh there, "
        "give the indenter rounder edges, or lower the load or the Poisson ratio."
    )
    NO_REST = (
        "The object loses its equilibrium: it buckles, folds at an edge, or slides off a support, and no other equilibrium was found. "
        "Support it better (friction, a wider plate), refine the mesh where it moves, or lower the load."
    )
    ALTERNATING_CONTACT = (
        "No equilibrium was found: points of contact alternate between touching, sticking and slipping. Refine the mesh at the contact, or "
        "lower the friction or the stiffness of contact."
    )
    SINGULAR = "The linear system is singular: the body can move freely. Constrain it by a fixed support, a tied contact, or friction."
    PENETRATION = (
        "A rigid body penetrates the object by more than a hundredth of an element, and no equilibrium was found with stiffer contact. "
        "Refine the mesh near the body's edge, lower the load, or allow for more penetration."
    )
    INTERRUPTED = "Interrupted by the user; what is returned is the best so far."
    ITERATION_LIMIT = (
        "The iteration limit was reached before the tolerance; the result may be used with care, or continued with more iterations."
    )

    @property
    def ok(self) -> bool:
        """Whether the result can be used without reserve."""
        return self is Status.CONVERGED
