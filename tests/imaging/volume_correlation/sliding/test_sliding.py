"""Where parts of an object slide on each other, the displacement jumps, and splines do not: their covariance must hold what they miss."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.measure_displacement import measure_displacement
from naibu.imaging.preprocessing.intensity_parts import intensity_parts
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.sliding.part_by_part import (
    correlated_parts,
    doubt_beside,
    jump_fraction,
    with_own_field,
    without_what_slides,
)
from naibu.validation.scanners.textures import Texture

SHAPE, SPACING_MM, SLIDE_MM = (44, 52, 60), (1.0, 1.0, 1.0), 6.0
MIDDLE_MM, HALF_AXES_MM = np.array([29.5, 25.5, 21.5]), np.array([22.0, 20.0, 17.0])
CELL_MM = 20.0
CHI_SQUARED_95 = 7.815  # three degrees of freedom


def below(points: FloatArray, tongue_mm: float) -> BoolArray:
    """Return which points belong to the lower half, with a tongue, 4 mm thick and as high as told, that it has within the upper one."""
    height = points[..., 2] - MIDDLE_MM[2]
    return np.asarray((height <= 0.0) | ((height < tongue_mm) & (np.abs(points[..., 1] - MIDDLE_MM[1]) < 2.5)))


def halves(points: FloatArray, slide_mm: float, tongue_mm: float = 0.0) -> FloatArray:
    """Return how the material at points moves: the upper half slides along x on the lower one, and along its tongue."""
    return np.where(below(points, tongue_mm)[..., None], 0.0, [slide_mm, 0.0, 0.0])


def scans(slide_mm: float, upper: float = 150.0, tongue_mm: float = 0.0) -> tuple[Volume, Volume, FloatArray, BoolArray]:
    """Return scans of a textured ball, its upper half as bright as told, the displacement (nz, ny, nx, 3), mm, and the ball."""
    frame = Volume.from_array(np.zeros(SHAPE), spacing_mm=SPACING_MM)
    x, grey, rng = positions(frame), Texture.drawn(2.5, seed=4), np.random.default_rng(1)

    def seen(at: FloatArray) -> FloatArray:
        inside = (((at - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1) < 1.0
        bright = np.where(below(at, tongue_mm), 150.0, upper)
        values = np.where(inside, bright + 30.0 * grey(at.reshape(-1, 3)).reshape(inside.shape), 10.0)
        return np.asarray(values + rng.normal(0.0, 2.0, values.shape))

    ball = (((x - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1) < 1.0
    moved = halves(x, slide_mm, tongue_mm)
    return frame.with_values(seen(x)), frame.with_values(seen(x - moved)), moved, ball


@cache
def own_fields(slide_mm: float) -> list[tuple[BoolArray, CorrelationResult]]:
    """Return the parts of a ball whose upper half is brighter, and the field of each."""
    before, after, _, ball = scans(slide_mm, upper=300.0)
    return [(part, correlate_volumes(before, after, mask=part)) for part in intensity_parts(before, ball)]


def covered(slide_mm: float) -> tuple[float, float, float]:
    """Return which part of all voxels, and of those next to the jump, the stated regions hold, and the median standard deviation, mm."""
    before, after, truth, ball = scans(slide_mm)
    found = correlate_volumes(before, after, mask=ball)
    here = np.argwhere(found.valid)
    points, error = found.volume.to_physical(here[:, ::-1]), (found.displacement.vectors - truth)[tuple(here.T)]
    covariance = found.covariance_at(points)
    held = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95
    near = np.abs(points[:, 2] - MIDDLE_MM[2]) < 3.0
    return float(held.mean()), float(held[near].mean()), float(np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2))))


def test_regions_hold_the_displacement_beside_a_jump() -> None:
    """Without what large residuals tell, they held .25 of it, and .78 of all."""
    everywhere, near, _ = covered(SLIDE_MM)
    assert near > 0.85 and everywhere > 0.9


def test_what_moves_as_one_is_no_less_certain_for_it() -> None:
    everywhere, _, sd = covered(0.0)
    assert everywhere > 0.9 and sd < 0.1


def test_parts_that_differ_in_intensity_are_measured_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """One field misses the jump by more than a millimetre in the mean of the voxels beside it; the fields of parts may jump."""
    before, after, truth, ball = scans(SLIDE_MM, upper=300.0)
    made: dict[str, Any] = {}

    def kept(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **options: made.setdefault(function.__name__, function(*args, **options))

    module = importlib.import_module("naibu.imaging.measure_displacement")
    for function in (correlate_volumes, correlated_parts):
        monkeypatch.setattr(module, function.__name__, kept(function))
    found = measure_displacement(before, after, mask=ball)
    one, parts = made["correlate_volumes"], [part for _, part in made["correlated_parts"]]
    assert found.facts["parts"] == len(parts) == 2  # both halves have their own field
    assert found.facts["residual_sd"] == max(part.residual_sd for part in parts)  # diagnostics are those of the worst part
    assert found.facts["unconverged_cells"] == sum((~part.converged).sum() for part in parts)
    near = ball & (np.abs(positions(before)[..., 2] - MIDDLE_MM[2]) < 3.0)

    def missed(vectors: FloatArray) -> float:
        return float(np.nanmean(np.linalg.norm((vectors - truth)[near], axis=-1)))

    assert missed(one.displacement.vectors) > 1.0
    assert missed(found.displacement.vectors) < 0.5 * missed(one.displacement.vectors)
    error, covariance = (
        (found.displacement.vectors - truth)[found.displacement.valid],
        found.displacement.covariance[found.displacement.valid],
    )
    held = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95
    assert found.displacement.valid[ball].mean() > 0.95 and held.mean() > 0.9
    # what models are fitted to is as certain as it says, too
    at = np.clip(np.rint(before.to_index(found.blocks.points)).astype(int), 0, np.array(SHAPE[::-1]) - 1).T
    off = found.blocks.vectors - truth[at[2], at[1], at[0]]
    held = np.einsum("ni,ni->n", off, np.linalg.solve(found.blocks.covariance, off[..., None])[..., 0]) < CHI_SQUARED_95
    assert held.mean() > 0.85


def test_a_part_that_matches_for_the_most_part_is_measured_by_itself() -> None:
    """Its field was refused, or taken for lost by what is not answered, and that of the whole, which another part drags along, stood."""
    before, after, truth, ball = scans(SLIDE_MM, upper=300.0)
    x = positions(before)
    other = 300.0 + 30.0 * Texture.drawn(2.5, seed=9)(x.reshape(-1, 3)).reshape(SHAPE)
    replaced = ball & (x[..., 2] > MIDDLE_MM[2] + 1.0) & (x[..., 0] > MIDDLE_MM[0] + 7.0)
    after = after.with_values(np.where(replaced, other, after.values))
    left = {"apart_fraction": lambda _: 0.5, "misplaced_fraction": 0.5, "misplacement_at": lambda at: np.full(len(at), 4.0)}
    whole: Any = SimpleNamespace(volume=before, **left)
    parts = correlated_parts(before, after, ball, whole)
    assert len(parts) == 2
    upper = parts[1][1]
    kept = ball & (x[..., 2] > MIDDLE_MM[2] + 3.0) & (x[..., 0] < MIDDLE_MM[0] - 5.0)
    error = np.linalg.norm(upper.displacement.vectors - truth, axis=-1)
    assert upper.valid[kept].all() and error[kept].mean() < 0.1
    assert upper.valid[replaced].mean() < 0.1


def test_what_cannot_be_measured_beside_a_part_that_slides_is_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """One field of all, which is wrong on both sides of where parts slide, stood there with a small standard deviation."""
    before, after, _, ball = scans(SLIDE_MM, upper=300.0)
    (lower, _), (upper, one) = own_fields(SLIDE_MM)
    module = importlib.import_module("naibu.imaging.measure_displacement")
    monkeypatch.setattr(module, "correlate_volumes", lambda *_, **__: one)
    monkeypatch.setattr(module, "correlated_parts", lambda *_, **__: ((upper, one),))
    found = measure_displacement(before, after, mask=ball)
    assert found.facts["parts"] == 1 and found.displacement.valid[upper].mean() > 0.9
    assert not found.displacement.valid[lower].any() and np.isnan(found.displacement.vectors[lower]).all()
    assert any("could not be measured by itself and is not answered" in warning for warning in found.warnings)


def test_what_slides_within_a_part_does_not_drag_the_rest_along() -> None:
    """As a liver within the wall of a chest: the wall was off by twice as much, and its regions held 79 per cent."""
    before, after, truth, ball = scans(10.0)
    found = correlate_volumes(before, after, mask=ball)
    rest = without_what_slides(before, after, ball, found)
    apart = np.abs(positions(before)[..., 2] - MIDDLE_MM[2])

    def off(one: CorrelationResult) -> FloatArray:
        return np.asarray(np.linalg.norm(one.displacement.vectors - truth, axis=-1))

    here = found.valid & rest.valid
    assert rest.valid[ball & (apart > 8.0)].mean() > 0.95
    assert off(rest)[here].mean() < 0.6 * off(found)[here].mean()


def test_what_may_still_be_what_slides_within_a_part_is_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the rim of a liver, which was answered as the wall about it moves, with a standard deviation of 0.3 mm, and off by 25 mm."""
    before, after, _, ball = scans(0.0, upper=300.0)
    x, (_, rest) = positions(before), own_fields(0.0)[0]
    found: Any = SimpleNamespace(
        volume=before,
        valid=ball,
        displacement=SimpleNamespace(vectors=np.zeros((*SHAPE, 3))),
        bending=np.ones(1),
        grid=SimpleNamespace(step_mm=np.full(3, CELL_MM)),
        misplacement_at=lambda at: np.where(at[:, 0] > MIDDLE_MM[0], 16.0, 0.0),
    )
    stiff = replace(rest, bending=np.full_like(rest.bending, 9.0))
    module = importlib.import_module("naibu.imaging.volume_correlation.sliding.part_by_part")
    monkeypatch.setattr(module, "correlate_volumes", lambda *_, **__: stiff)
    answered = without_what_slides(before, after, ball, found)
    beside = x[..., 0] - MIDDLE_MM[0]
    near = np.abs(beside) < 0.15 * CELL_MM
    assert rest.valid[near].any() and not answered.valid[near].any()
    assert (answered.valid == rest.valid)[beside < -0.25 * CELL_MM].all()
    assert (np.isfinite(answered.displacement.vectors).all(axis=-1) == answered.valid)[ball].all()


def test_a_thin_tongue_of_a_part_within_another_is_not_answered_as_that_one_moves() -> None:
    """As the tissue between lungs: of such a tongue, 36 per cent were outside the stated regions, off by the slide."""
    before, after, truth, ball = scans(SLIDE_MM, upper=300.0, tongue_mm=5.0)
    # as far as the tongue reaches, and the parts beside it
    before, after = (each.cropped((0, 15, 10), (60, 36, 36)) for each in (before, after))
    truth, ball = truth[10:36, 15:36], ball[10:36, 15:36]
    left = {"apart_fraction": lambda _: 0.5, "misplaced_fraction": 0.5, "misplacement_at": lambda at: np.full(len(at), 4.0)}
    whole: Any = SimpleNamespace(volume=before, **left)
    parts = correlated_parts(before, after, ball, whole)
    x = positions(before)
    height = x[..., 2] - MIDDLE_MM[2]
    tongue = ball & (truth[..., 0] == 0.0) & (height > 2.0)
    assert len(parts) == 2 and tongue.sum() > 200
    missed = np.zeros(before.shape, dtype=bool)
    for one, other in permutations(parts, 2):
        at, doubt = doubt_beside(one, other)
        there = np.zeros((*before.shape, 3, 3))
        there[at] = doubt
        here = np.argwhere(tongue & one[0] & one[1].valid)
        error = (one[1].displacement.vectors - truth)[tuple(here.T)]
        covariance = one[1].covariance_at(before.to_physical(here[:, ::-1])) + there[tuple(here.T)]
        missed[tuple(here.T)] = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) > CHI_SQUARED_95
    assert missed[tongue].mean() < 0.05
    answered = np.logical_or.reduce([part & own.valid for part, own in parts])
    assert answered[ball & (height > 2.0) & ~ndimage.binary_dilation(tongue, iterations=2)].mean() > 0.9


def test_an_object_that_moves_as_one_is_measured_as_one() -> None:
    before, after, _, ball = scans(0.0, upper=500.0)
    assert "parts" not in measure_displacement(before, after, mask=ball).facts


def test_a_small_slide_is_seen_where_the_fields_of_parts_differ() -> None:
    """One field leaves nothing of it further apart than a voxel."""
    before, after, truth, ball = scans(2.0, upper=300.0)
    found = measure_displacement(before, after, mask=ball)
    assert found.facts["parts"] == 2
    # on either side of the surface a voxel is half of the one part and half of the other: regions hold either
    beside = ball & (np.abs(positions(before)[..., 2] - MIDDLE_MM[2]) < 1.0) & found.displacement.valid
    error, covariance = (found.displacement.vectors - truth)[beside], found.displacement.covariance[beside]
    held = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95
    assert held.mean() > 0.9


def test_parts_that_move_as_one_do_not_jump_and_what_jumps_is_in_doubt_beside_it() -> None:
    fields = {slide_mm: own_fields(slide_mm) for slide_mm in (0.0, SLIDE_MM)}
    assert jump_fraction(*fields[0.0]) < 0.02
    assert jump_fraction(*fields[SLIDE_MM]) > 0.5
    (part, _), (other, _) = fields[SLIDE_MM]
    at, doubt = doubt_beside(*fields[SLIDE_MM])
    assert part[at].all() and not other[at].any()
    assert other[np.maximum(at[0] - 1, 0), at[1], at[2]].mean() + other[at[0] + 1, at[1], at[2]].mean() > 0.9  # a layer of one voxel
    # a quarter of the square of the slide, along it
    assert np.median(doubt[:, 0, 0]) == pytest.approx(0.25 * SLIDE_MM**2, rel=0.1)
    assert np.median(doubt[:, 1, 1]) < 0.1


def test_a_field_that_has_lost_its_way_is_no_witness_of_a_slide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a chest that moves as one, measured well by one field, 70 per cent were not answered: the own field of its wall was lost."""
    before, after, _, ball = scans(0.0, upper=300.0)
    own = own_fields(0.0)
    away = own[1][1].coefficients + np.array([2.0, 0.0, 0.0])
    lost = replace(own[1][1], coefficients=away, cell_misplacement=np.where(np.isfinite(own[1][1].cell_misplacement), 1.0, np.nan))
    left = {"apart_fraction": lambda _: 0.02, "misplaced_fraction": 0.0, "misplacement_at": lambda at: np.full(len(at), 1e-4)}
    whole: Any = SimpleNamespace(volume=before, **left)
    assert jump_fraction(own[0], (own[1][0], lost)) > 0.9
    module = importlib.import_module("naibu.imaging.volume_correlation.sliding.part_by_part")
    fields = iter((own[0][1], lost))
    monkeypatch.setattr(module, "correlate_volumes", lambda *_, **__: next(fields))
    assert correlated_parts(before, after, ball, whole) == ()


def test_fields_of_parts_that_leave_less_than_half_a_voxel_are_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is in one scan only, at the surface of parts that slide, is left apart by their own fields, however right they are."""
    before, after, _, ball = scans(SLIDE_MM, upper=300.0)
    own = own_fields(SLIDE_MM)
    fields = iter([replace(f, cell_misplacement=np.where(np.isfinite(f.cell_misplacement), 0.16, np.nan)) for _, f in own])
    left = {"apart_fraction": lambda _: 0.02, "misplaced_fraction": 0.01, "misplacement_at": lambda at: np.full(len(at), 1e-4)}
    whole: Any = SimpleNamespace(volume=before, **left)
    module = importlib.import_module("naibu.imaging.volume_correlation.sliding.part_by_part")
    monkeypatch.setattr(module, "correlate_volumes", lambda *_, **__: next(fields))
    assert len(correlated_parts(before, after, ball, whole)) == 2


def test_parts_that_jump_keep_their_own_field() -> None:
    """But for one that has lost its way by more than a little."""
    assert with_own_field([(1.0, 1.0), (0.9, 1.0)], jumping=True) == [True, True]
    assert with_own_field([(0.5, 0.1), (2.1, 1.0)], jumping=True, little_mm=0.6) == [True, False]


@pytest.mark.parametrize(
    ("left_mm", "chosen"),
    [
        ([(0.79, 1.0), (1.5, 1.0)], [True, True]),  # one field is wrong on both sides of where parts slide
        ([(1.0, 1.0), (0.39, 0.5)], [True, True]),
        ([(0.8, 1.0), (0.9, 1.0)], [False, False]),  # no part gains a fifth: they move as one
        ([(0.81, 1.0), (0.4, 0.5)], [False, False]),
        ([(0.0, 0.0), (0.9, 1.0)], [False, False]),
        ([(0.5, 1.0), (2.0, 1.0)], [True, True]),
        ([(0.5, 1.0), (2.01, 1.0)], [True, False]),  # a field that has lost its way is no answer
        ([(0.5, 1.0), (np.nan, 1.0)], [True, False]),
        ([(0.5, 1.0)], [True]),  # the other part cannot be measured by itself
        ([], []),
    ],
)
def test_every_part_has_its_own_field_once_one_gains_by_it(left_mm: list[tuple[float, float]], chosen: list[bool]) -> None:
    """Of the mean distances that the own field of each part, and that of the whole, leave between structures."""
    assert with_own_field(left_mm) == chosen
