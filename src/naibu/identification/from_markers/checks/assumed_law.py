"""The law that was assumed: whether the data speak against it, and whether what was found hangs on it."""

from __future__ import annotations

import numpy as np

from naibu.core.parameters import Parameter
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.marker_checks import Doubt
from naibu.identification.from_markers.law_uncertainty import LawUncertainty, OtherLaw

UNLIKELY = 1e-3  # probability of so large a score by chance, below which the data speak against the law
MODULUS, POISSON = 0.1, 0.01  # change from which on it matters: of the logarithm of a modulus, of a Poisson's ratio
HANGS = 1.5  # times its standard deviation with the law taken for right: what is so much less certain hangs on the law
KINDS = {": young_modulus": "moduli", ": poisson_ratio": "Poisson's ratios"}
HANGING = tuple(KINDS)
LISTED = 2


def contradicted_law(calibration: Calibration, law: LawUncertainty) -> tuple[Doubt, ...]:
    """Doubt a law where the data ask for another one, under which a modulus or a Poisson's ratio would be another one by much."""
    for other in law.others[:1]:
        moved = _moved(calibration, other)
        if other.probability < UNLIKELY and moved:
            text = (
                f"the law does not fit: markers ask for stress that grows otherwise with strain, as in a {other.name} law; to first order "
                f"{' and '.join(moved[:LISTED])} then; identify with the law {other.name}, and compare"
            )
            return (Doubt(text),)
    return ()


def _moved(calibration: Calibration, other: OtherLaw) -> list[str]:
    """Say what would change by much under another law, moduli first and those that change most."""
    told = []
    for p, shift in zip(calibration.match.parameters.free, other.shift.tolist(), strict=True):
        if text := _change(p, shift):
            told.append((p.scale != "log", -abs(shift), text))
    return [text for *_, text in sorted(told)]


def _change(p: Parameter, shift: float) -> str:
    """Say by how much a modulus or a Poisson's ratio would change; empty for other parameters, and for little."""
    if p.name.endswith(": young_modulus") and abs(shift) > MODULUS:
        return f"{p.name} would be {100.0 * abs(np.expm1(shift)):.0f} % {'higher' if shift > 0.0 else 'lower'}"
    there = p.physical(p.inner(p.value) + shift)
    if p.scale == "incompressibility" and abs(there - p.value) > POISSON:
        return f"{p.name} would be {there:.3f} rather than {p.value:.3f}"
    return ""


def hangs_on_law(calibration: Calibration, law: LawUncertainty) -> str:
    """Say, in words that follow "but", what hangs on the assumed law; empty where nothing does."""
    own, more = np.diag(calibration.covariance), np.diag(law.covariance)
    hangs = [p.name for p, one, other in zip(calibration.match.parameters.free, own, more, strict=True) if one + other > HANGS**2 * one]
    told = [word for kind, word in KINDS.items() if any(name.endswith(kind) for name in hangs)]
    return f"{' and '.join(told)} hang on the assumed law" if told else ""
