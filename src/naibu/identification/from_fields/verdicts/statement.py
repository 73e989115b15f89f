"""What an identification says in words: its verdict, what limits it, how well moduli are determined, and what else they might be."""

from __future__ import annotations

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.assumptions.other_assumptions import Assumption, effects
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.uncertainty import ErrorBudget, Uncertainty, intervals, report
from naibu.identification.verdict import Explanation, Verdict


def statement(
    judged: Verdict,
    zones: Zones,
    theta: FloatArray,
    found: Uncertainty,
    others: tuple[Assumption, ...],
    *,
    limits: tuple[str, ...] = (),
    measure: tuple[str, ...] = (),
    budget: ErrorBudget | None = None,
) -> tuple[str, ...]:
    """Return the sentences of an identification of regions, the verdict first.

    Parameters
    ----------
    judged : Verdict
        On the residuals.
    zones : Zones
        Their names and the unit of moduli.
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu).
    found : Uncertainty
        Of theta.
    others : tuple of Assumption
        What else may be assumed.
    limits : tuple of str
        Why elements are too coarse for a modulus to be called well determined; empty where they are not.
    measure : tuple of str
        In what moduli are told, where they have no unit.
    budget : ErrorBudget, optional
        Where the uncertainty stems from.
    """
    sure = judged.explanation is Explanation.EXPLAINED and not limits
    how_well = report(zones, theta, found, budget=budget, usable=judged.ok, sure=sure, unit=zones.unit, apart=judged.mesh_dependent)
    told = effects(others, zones, theta, intervals(theta, found)[0])
    return (judged.sentence, *limits, *measure, *judged.notes, *how_well, *told)
