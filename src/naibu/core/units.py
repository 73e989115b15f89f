"""Parsing of quantities with a unit, such as ``"222 kPa"``; all other code uses mm, kg, s, mN and kPa."""

from __future__ import annotations

import re

import numpy as np

from naibu.core.errors import InputError

_KILOPASCALS = {"Pa": 1e-3, "kPa": 1.0, "MPa": 1e3, "GPa": 1e6, "N/m^2": 1e-3, "N/mm^2": 1e3}
MODULI_KPA = 1e-6, 1e10  # diamond: 1.2e9 kPa


def kilopascals(text: str) -> float:
    """Return a pressure or elastic modulus in kPa; a number without a unit is taken as kPa.

    Raises
    ------
    InputError
        Not a number, an unknown unit, or a value that no material has.
    """
    match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([A-Za-z/^0-9]*)\s*", text)
    try:
        value = float(match.group(1)) if match else np.nan
    except ValueError:
        value = np.nan
    unit = (match.group(2) if match else "") or "kPa"
    if unit not in _KILOPASCALS or not np.isfinite(value):
        raise InputError(f"{text!r} is not a modulus; write a number and one of {', '.join(_KILOPASCALS)}, such as '222 kPa'")
    if not value > 0.0:
        raise InputError(f"a modulus must be positive, not {text!r}")
    modulus = value * _KILOPASCALS[unit]
    softest, stiffest = MODULI_KPA
    if not softest <= modulus <= stiffest:
        raise InputError(f"no material has a modulus of {text!r}; it must lie between {softest:g} and {stiffest:g} kPa")
    return modulus
