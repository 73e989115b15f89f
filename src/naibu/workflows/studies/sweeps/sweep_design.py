"""The points of a parameter sweep: grids, Latin hypercubes :cite:p:`mckay1979` and Sobol sequences :cite:p:`sobol1967`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.io.study_schemas.sweep_schema import ParameterTable, SweepFile


def design(sweep: SweepFile) -> FloatArray:
    """Return the values (runs, parameters) of a sweep, in the order of its file.

    Latin hypercubes are made by `scipy.stats.qmc.LatinHypercube`, Sobol points by `scipy.stats.qmc.Sobol`, scrambled
    (:cite:p:`owen1998`); both from the seed of the sweep, so that every call gives the same points. The first runs of a longer Sobol
    sequence are those of a shorter one.

    Parameters
    ----------
    sweep : SweepFile
        Checked contents of the file.
    """
    from scipy.stats import qmc  # slow to load, and not needed by workers

    tables = sweep.parameter
    if sweep.sweep.method == "grid":
        return np.array(list(product(*(_levels(table) for table in tables))), dtype=float)
    random = np.random.default_rng(sweep.sweep.seed)
    count = sweep.sweep.samples or 1
    if sweep.sweep.method == "latin_hypercube":
        unit = qmc.LatinHypercube(len(tables), seed=random).random(count)
    else:
        unit = qmc.Sobol(len(tables), seed=random).random_base2(max(count - 1, 0).bit_length())[:count]
    return np.stack([_scaled(table, unit[:, k]) for k, table in enumerate(tables)], axis=1)


def _levels(table: ParameterTable) -> Sequence[float]:
    if table.values is not None:
        return table.values
    return [float(value) for value in _scaled(table, np.linspace(0.0, 1.0, table.count or 2))]


def _scaled(table: ParameterTable, unit: FloatArray) -> FloatArray:
    """Return numbers between 0 and 1 as values between low and high, whose ends are met exactly."""
    low, high = float(table.low or 0.0), float(table.high or 0.0)
    if table.scale == "log":
        return np.clip(low * (high / low) ** unit, low, high)
    return np.clip(low + (high - low) * unit, low, high)
