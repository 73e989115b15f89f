"""Markers that do not move with their neighbours: mislabelled, or misplaced by far more than the noise.

The displacement of a body is smooth between its markers. Each is compared with the median of its neighbours, as in the median test of
particle image velocimetry (:cite:p:`westerweel2005`), after a smooth field has been subtracted: a robust quadratic polynomial before
anything is solved, the solution of the model afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.markers import Markers
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, NoiseModel
from naibu.identification.from_markers.specimen.marker_grid import lattice_indices
from naibu.identification.neighbours import neighbours

FEWEST = 30  # markers that bear a quadratic polynomial and a median of neighbours
NEIGHBOURS = 8
GROSS = 10.0  # standard deviations from the neighbours
GROSS_SPACING = 0.6  # the same in distances between neighbours, where only a polynomial was subtracted: 0.45 occur beside a bar
POOR = 3.0  # standard deviations from the neighbours at the median: of so poor a fit no marker is an exception
MOST = 0.1  # of the markers; more are no outliers but another object


@dataclass(frozen=True, slots=True)
class Outlier:
    """A marker that was left out of a state.

    Attributes
    ----------
    experiment, state : str
        Where.
    marker : int
        Its label.
    axis : str
        Axis along which it is off most.
    offset_mm : float
        By how much, mm: measured minus what its neighbours, or the model, make of it.
    """

    experiment: str
    state: str
    marker: int
    axis: str
    offset_mm: float


def without_outliers(
    experiments: Sequence[Experiment], states: Mapping[str, Sequence[str]] | None = None
) -> tuple[list[Experiment], tuple[Outlier, ...]]:
    """Return the experiments with gross outliers marked as not trusted, and a list of these.

    An outlier that lies off its lattice by as much in the reference configuration is taken from there, and so from every state.

    Raises
    ------
    InputError
        More than a tenth of the markers of a state do not move with their neighbours.
    """
    cleaned, found = [], []
    for e in experiments:
        if e.dimensions == 3:
            for name in (states or {}).get(e.name, [s.name for s in e.loaded_states]):
                outliers = _of_state(e, e.state(name))
                e = _distrusted(e, outliers)
                found += outliers
        cleaned.append(e)
    return cleaned, tuple(found)


def outliers_of_fit(load_case: MarkerLoadCase, fit: LoadCaseFit) -> tuple[Outlier, ...]:
    """Return the markers that a solved load case leaves far from both the model and their neighbours; none where these are many."""
    body = load_case.specimen
    whole = np.isfinite(fit.residual).all(axis=1)
    if whole.sum() < FEWEST:
        return ()
    sd = np.sqrt((fit.sd[whole] ** 2).mean(axis=0))
    far, difference = isolated(body.marker_points[whole], fit.residual[whole], sd)
    if far.mean() > MOST or (np.median(np.abs(difference), axis=0) > POOR * sd).any():
        return ()
    label = body.experiment.name, load_case.state
    return tuple(_outlier(*label, int(i), r) for i, r in zip(body.marker_ids[whole][far], fit.residual[whole][far], strict=True))


def isolated(points: FloatArray, residual: FloatArray, sd: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Tell which residuals (k, 3), mm, differ grossly from those of their neighbours, and return the differences (k, 3).

    Parameters
    ----------
    points : ndarray, shape (k, 3)
        Where they were found, mm.
    residual : ndarray, shape (k, 3)
        mm.
    sd : ndarray, shape (3,)
        Standard deviation of a residual, mm; the median absolute difference replaces it where that is larger.
    """
    difference = np.asarray(residual - np.median(residual[neighbours(points, NEIGHBOURS)[1]], axis=1))
    scale = np.maximum(1.4826 * np.median(np.abs(difference), axis=0), sd)
    return np.asarray((np.abs(difference) > GROSS * scale).any(axis=1)), difference


def _outlier(experiment: str, state: str, marker: int, offset: FloatArray) -> Outlier:
    axis = int(np.argmax(np.abs(offset)))
    return Outlier(experiment, state, marker, "xyz"[axis], float(offset[axis]))


def _of_state(e: Experiment, state: State) -> list[Outlier]:
    if state.markers is None:
        return []
    scale = np.array([e.xy_scale, e.xy_scale, 1.0])
    ids = e.initial.ids
    free, loaded = e.initial.aligned(ids) * scale, state.markers.aligned(ids) * scale
    whole = np.isfinite(free).all(axis=1) & np.isfinite(loaded).all(axis=1)
    ids, free, loaded = ids[whole], free[whole], loaded[whole]
    if len(ids) < FEWEST:
        return []
    sd = np.sqrt(2.0) * NoiseModel().of_experiment(e)
    far, difference = isolated(free, _from_polynomial(free, loaded), sd)
    spacing = float(np.median(neighbours(free, 1)[0]))
    far &= (np.abs(difference) > GROSS_SPACING * spacing).any(axis=1)
    if far.mean() > MOST:
        names = ", ".join(str(i) for i in ids[far][:5])
        raise InputError(
            f"{e.name}/{state.name}: {far.sum()} of {len(ids)} markers do not move with their neighbours (markers {names}, ...), by up to "
            f"{np.abs(difference).max():.1f} mm; the same marker must have the same label in both states"
        )
    misplaced = _off_lattice(e) if far.any() else {}
    return [
        _outlier(e.name, e.states[0].name, int(i), misplaced[int(i)]) if int(i) in misplaced else _outlier(e.name, state.name, int(i), d)
        for i, d in zip(ids[far], difference[far], strict=True)
    ]


def _from_polynomial(points: FloatArray, moved: FloatArray) -> FloatArray:
    """Return the distance (k, 3), mm, of a displacement from the robust quadratic polynomial of the position."""
    y = (points - points.mean(axis=0)) / points.std(axis=0).max()
    terms = [np.ones(len(y)), *y.T, *(y[:, i] * y[:, j] for i in range(3) for j in range(i, 3))]
    design, weight = np.column_stack(terms), np.ones(len(y))
    for _ in range(30):
        found = np.linalg.lstsq(design * weight[:, None], (moved - points) * weight[:, None], rcond=None)[0]
        residual = moved - points - design @ found
        weight = 1.0 / np.sqrt(np.maximum(np.linalg.norm(residual, axis=1), 0.05))
    return np.asarray(residual)


def _off_lattice(e: Experiment) -> dict[int, FloatArray]:
    """Labels and offsets (3,), mm, of markers that lie grossly off their places in the lattice of the reference configuration."""
    ids = e.initial.ids
    points = e.initial.aligned(ids)
    index: IntArray | None = lattice_indices(ids, points) if len(ids) else None
    if index is None:
        return {}
    whole = np.isfinite(points).all(axis=1)
    places, points = index[whole].astype(float), points[whole]
    residual = _from_polynomial(places, places + points)
    far, difference = isolated(places, residual, NoiseModel().of_experiment(e))
    spacing = float(np.median(neighbours(points, 1)[0]))
    far &= (np.abs(difference) > 0.5 * GROSS_SPACING * spacing).any(axis=1)
    return {int(i): d for i, d in zip(ids[whole][far], difference[far], strict=True)}


def _distrusted(e: Experiment, outliers: Sequence[Outlier]) -> Experiment:
    """Return the experiment with outliers marked as not trusted in their states."""
    names = {o.state for o in outliers}
    states = tuple(
        replace(s, markers=_without(s.markers, [o.marker for o in outliers if o.state == s.name]))
        if s.name in names and s.markers is not None
        else s
        for s in e.states
    )
    return replace(e, states=states) if names else e


def _without(markers: Markers, labels: Sequence[int]) -> Markers:
    return replace(markers, trusted=markers.trusted & ~np.isin(markers.ids, labels))


def distrusted(experiments: Sequence[Experiment], outliers: Sequence[Outlier]) -> list[Experiment]:
    """Return the experiments with outliers marked as not trusted."""
    return [_distrusted(e, [o for o in outliers if o.experiment == e.name]) for e in experiments]
