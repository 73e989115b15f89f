"""Measurements that their neighbours contradict: gross errors of matching, which no noise and no deformation makes.

The normalised median test of :cite:t:`westerweel2005`, in the form for scattered points of :cite:t:`duncan2010`: the difference of a
vector from what its neighbours tell for its place, over the median of the like differences of these neighbours. What they tell is a
displacement linear in space, so that strain and one-sided neighbours at a surface are no contradiction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.neighbours import neighbours

NEIGHBOURS = 20  # a linear displacement in space takes four
TIMES = 8.0  # medians of the differences around: of normal errors of three components none in 10^25 is so large
STATED = 6.0  # standard deviations that are stated for a component
FLOOR = 0.05  # of the median difference of all points: least of the median around, where a field is smoother than its numbers tell
MOST = 0.25  # part of the points: of so many none can be called the exception
PASSES = 3


def without_contradicted(load_case: FieldLoadCase) -> tuple[FieldLoadCase, tuple[str, ...]]:
    """Return the load case without measurements that their neighbours contradict, and what was left out, in words."""
    wrong = contradicted(load_case.field)
    if not wrong.any():
        return load_case, ()
    field, kept = load_case.field, ~wrong
    covariance = None if field.covariance is None else field.covariance[kept]
    fewer = DisplacementField.from_arrays(field.points[kept], field.vectors[kept], covariance=covariance)
    told = (
        f"{load_case.name}: {int(wrong.sum())} of {len(wrong)} measurements in the object are left out as outliers: they differ from what "
        f"their neighbours tell more than {TIMES:g} times as much as is usual there (normalised median test)."
    )
    return replace(load_case, field=fewer), (told,)


def contradicted(field: DisplacementField) -> BoolArray:
    """Return which measurements (n,) of a field at points their neighbours contradict; none where a quarter of all seem to.

    Parameters
    ----------
    field : DisplacementField
        Measurements, all valid, mm.
    """
    points, vectors = field.points, field.vectors
    wrong = np.zeros(len(points), dtype=bool)
    if len(points) <= 2 * NEIGHBOURS:
        return wrong
    near = neighbours(points, NEIGHBOURS)[1]
    expected = np.median(vectors[near], axis=1)
    for _ in range(PASSES):
        apart = np.linalg.norm(vectors - expected, axis=1)
        around = np.median(np.where(wrong[near], np.inf, apart[near]), axis=1)
        least = FLOOR * float(np.median(apart))
        wrong = apart > TIMES * np.maximum(around, least)
        if field.covariance is not None:
            wrong &= apart > STATED * np.sqrt(np.trace(field.covariance, axis1=1, axis2=2))
        expected = _told_by(points, vectors, near, ~wrong)
    return wrong if wrong.mean() <= MOST else np.zeros_like(wrong)


def _told_by(points: FloatArray, vectors: FloatArray, near: IntArray, right: BoolArray) -> FloatArray:
    """Return the displacement (n, d), mm, that is linear in space and fits best at those neighbours (n, k) that are `right` (n,)."""
    weight = right[near].astype(float)
    away = points[near] - points[:, None]
    scale = np.sqrt((away**2).sum(axis=2).mean(axis=1))
    linear = np.concatenate([np.ones((*near.shape, 1)), away / np.maximum(scale, 1e-300)[:, None, None]], axis=2)
    weighted = linear * weight[..., None]
    matrix = np.swapaxes(weighted, 1, 2) @ linear + 1e-3 * weight.sum(axis=1)[:, None, None] * np.diag([0.0] + [1.0] * points.shape[1])
    matrix[:, 0, 0] += 1e-9
    return np.asarray(np.linalg.solve(matrix, np.swapaxes(weighted, 1, 2) @ vectors[near])[:, 0])
