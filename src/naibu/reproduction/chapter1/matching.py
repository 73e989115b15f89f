"""Feature matching of chapter 1 of :cite:t:`hirai2008`: matches by every strength, Delaunay nets and fields, and their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.feature_matching.correlation_matching import Candidates, candidate_matches
from naibu.imaging.feature_matching.harris import InterestPoints, interest_points
from naibu.imaging.feature_matching.relaxation_labelling import STRENGTHS, PotentialMatches, Strength, relaxed
from naibu.imaging.feature_matching.scattered_interpolation import Triangulation, dense_from_sparse, sparse_displacement, triangulated
from naibu.imaging.preprocessing.resampling import sampled
from naibu.imaging.preprocessing.rigid_registration import RigidRegistration, rigid_from_points
from naibu.reproduction.chapter1.calf_motion import TIBIA
from naibu.reproduction.chapter1.calf_phantom import FIELD_OF_VIEW_MM, CalfCase

WAYS: tuple[Strength, ...] = tuple(STRENGTHS)
# half the boxes of the report, voxels of its pixel size; they grow with the distance from the centre of a slice, at a rate it does not say
MATCH, SEARCH, GROWTH = (4, 4, 1), (8, 8, 1), 1.0
REPORT_PIXEL_MM = FIELD_OF_VIEW_MM / 256
LEAST_SCORE = 0.6
# alpha from 0 to 10 by tenths makes the 101 iterations of Table 1.1
ALPHA_STEP, ALPHA_MAX, MOST_ITERATIONS = 0.1, 10.0, 101
RIGHT_MM = 2.0
CHECK_POINTS, CHECK_POINTS_APART_MM, CHECK_POINTS_UNDER_MM = 10, 15.0, 3.0
# of the report's 57 slices those from 10 to 50 count
FIRST_FRACTION, LAST_FRACTION = 10 / 56, 50 / 56
_RIM_MM = 13.0  # where points on the tibia are picked: at its surface, nearly


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Matches of one strength, and the field from them.

    Attributes
    ----------
    name : str
        Name of the strength; ``"correlation alone"`` without relaxation.
    matches : PotentialMatches
        The match set.
    errors_mm : ndarray, shape (n,)
        Distance of every matched point from the true position of its partner, mm; in an image, within the slice.
    net : Triangulation
        Delaunay net of the reference points.
    dense : DisplacementField
        Its quality is 1 inside the net; outside it is extrapolated by the least-squares affine motion of all points.
    """

    name: str
    matches: PotentialMatches
    errors_mm: FloatArray
    net: Triangulation
    dense: DisplacementField

    @property
    def right_percent(self) -> float:
        """Fraction of matches within 2 mm of the truth, %."""
        return 100.0 * float(np.mean(self.errors_mm < RIGHT_MM))

    def moved_back(self, points_mm: FloatArray, grid: Volume) -> FloatArray:
        """Return the reference positions of deformed points (k, 3), mm, by the net of the matched deformed points."""
        backward = DisplacementField.from_arrays(self.matches.deformed_mm, self.matches.reference_mm - self.matches.deformed_mm)
        vectors = dense_from_sparse(backward, grid, outside="affine").vectors
        at = [sampled(grid.with_values(component), points_mm) for component in np.moveaxis(vectors, -1, 0)]
        return np.asarray(points_mm + np.stack(at, axis=-1))


def picked_registration(case: CalfCase) -> RigidRegistration:
    """Return the motion of the tibia from points picked on its rim, as the report does: three in an image, eighteen in a volume.

    Points are picked with the accuracy of a voxel, as by hand.
    """
    grid = case.reference
    plane = grid.shape[0] == 1
    angles = np.radians([30.0, 150.0, 270.0] if plane else [30.0, 90.0, 150.0, 210.0, 270.0, 330.0])
    rim = np.array(TIBIA) + _RIM_MM * np.column_stack([np.cos(angles), np.sin(angles)])
    first, last = grid.to_physical([(0, 0, 0), (0, 0, grid.shape[0] - 1)])[:, 2]
    heights = [first] if plane else list(first + (last - first) * np.array([0.25, 0.5, 0.75]))
    points = np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in heights])
    before, after = (grid.to_physical(np.rint(grid.to_index(p))) for p in (points, case.motion.to_space(points)))
    if not plane:
        return rigid_from_points(before, after)
    found = rigid_from_points(before[:, :2], after[:, :2])
    rotation = np.eye(3)
    rotation[:2, :2] = found.transform.rotation
    return RigidRegistration(RigidTransform.of(rotation, [*found.transform.translation, 0.0]), found.residuals_mm)


def candidates_of(
    reference: Volume,
    deformed: Volume,
    counts: tuple[int, int],
    rigid: RigidTransform | None,
    *,
    reach: float = 1.0,
    boxes: tuple[tuple[int, int, int], tuple[int, int, int]] = (MATCH, SEARCH),
) -> tuple[Candidates, InterestPoints, InterestPoints]:
    """Return candidate pairs, and the interest points of the reference and the deformed volume.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair.
    counts : tuple of int
        Interest points in the reference and the deformed volume.
    rigid : RigidTransform, optional
        Motion to the centres of the search boxes; without it these do not grow.
    reach : float
        Factor on the search box along x and y.
    boxes : tuple of tuple of int
        Half the boxes that are matched and searched, in pixels of the report.
    """
    finer = REPORT_PIXEL_MM / reference.spacing_mm[0]
    match = (*(max(round(m * finer), 2) for m in boxes[0][:2]), boxes[0][2])
    search = (*(round(s * finer * reach) for s in boxes[1][:2]), boxes[1][2])
    border = np.array(match)
    before, after = (interest_points(v, count=n, border=border) for v, n in zip((reference, deformed), counts, strict=True))
    growth = 0.0 if rigid is None else GROWTH
    pairs = candidate_matches(
        reference, deformed, before.points_mm, after.points_mm,
        search=search, match=match, rigid=rigid, least_score=LEAST_SCORE, search_growth=growth,
    )  # fmt: skip
    return pairs, before, after


def potential_matches(pairs: Candidates, strength: Strength | None) -> PotentialMatches:
    """Return the match set of a strength as in the report: alpha grows by a tenth 100 times; None stands for correlation alone."""
    if strength is None:
        return relaxed(pairs, strength="chen", max_iterations=1)
    return relaxed(pairs, strength=strength, alpha_step=ALPHA_STEP, alpha_max=ALPHA_MAX, max_iterations=MOST_ITERATIONS)


def match_errors(case: CalfCase, found: PotentialMatches) -> FloatArray:
    """Return the distance of matches (n,) from their true positions, mm; in an image, within the slice."""
    away = found.deformed_mm - case.motion.to_space(found.reference_mm)
    return np.asarray(np.linalg.norm(away[:, :2] if case.reference.shape[0] == 1 else away, axis=1))


def matched(case: CalfCase, pairs: Candidates, strength: Strength | None) -> Matched:
    """Return the matches of one strength, with net and field."""
    found = potential_matches(pairs, strength)
    field = sparse_displacement(found)
    net = triangulated(field.points, case.reference)
    dense = dense_from_sparse(field, case.reference, outside="affine")
    return Matched(strength or "correlation alone", found, match_errors(case, found), net, dense)


def continued(vectors: FloatArray, grid: Volume) -> FloatArray:
    """Return a displacement (nz, ny, nx, 3), mm, with unknown vectors replaced by those of the nearest known voxel.

    Tissue that has left the outline of the leg needs such a field to be moved back, as the inverse motion begins outside.
    """
    unknown = np.asarray(~np.isfinite(vectors).all(axis=-1))
    nearest = ndimage.distance_transform_edt(unknown, sampling=grid.spacing_mm[::-1], return_distances=False, return_indices=True)
    return np.asarray(vectors[tuple(nearest)])


@dataclass(frozen=True, slots=True, eq=False)
class CheckPoints:
    """Ten conspicuous points of the reference and the deformed image (k, 3), mm."""

    reference_mm: FloatArray
    deformed_mm: FloatArray

    def errors_mm(self, ends_mm: FloatArray) -> FloatArray:
        """Return the distance (k,), mm, of deformed points, moved back to these positions (k, 3), from the reference points."""
        return np.asarray(np.linalg.norm(ends_mm - self.reference_mm, axis=1))


def check_points(case: CalfCase) -> CheckPoints:
    """Return the strongest interest points of an image of the calf, under the skin and apart, with their true deformed positions."""
    deep = ndimage.distance_transform_edt(case.leg[0], sampling=case.reference.spacing_mm[1::-1]) > CHECK_POINTS_UNDER_MM
    found = interest_points(case.reference, count=CHECK_POINTS, min_distance_mm=CHECK_POINTS_APART_MM, mask=deep[None])
    after = case.motion.to_space(found.points_mm)
    after[:, 2] = found.points_mm[:, 2]
    return CheckPoints(found.points_mm, after)


def judged_slices(grid: Volume) -> slice:
    """Return the slices that count, those from 10 to 50 where there are 57."""
    last = grid.shape[0] - 1
    return slice(round(FIRST_FRACTION * last), round(LAST_FRACTION * last) + 1)


def judged(case: CalfCase) -> tuple[BoolArray, BoolArray]:
    """Return the voxels of tissue in the slices that count, before and after."""
    within = np.zeros(case.reference.shape, dtype=bool)
    within[judged_slices(case.reference)] = True
    return within & case.leg, within & case.tissue_after


@dataclass(frozen=True, slots=True)
class NoiseRow:
    """Mean over noise realisations: matches, and the fraction of right ones, %."""

    noise: float
    registered: bool
    way: str
    candidates: float
    matches: float
    right: float
    right_percent: float


def under_noise(case: CalfCase, counts: tuple[int, int], levels: tuple[float, ...], draws: int, seed: int) -> list[NoiseRow]:
    """Match one image pair with increasing noise, with and without registration first, by every strength."""
    rigid = picked_registration(case).transform
    rows = []
    for level in levels:
        for motion in (rigid, None):
            seen: dict[str, list[tuple[float, float, float]]] = {}
            for draw in range(draws):
                rng = np.random.default_rng([seed, 11, draw])
                noisy = [
                    v.with_values(np.clip(v.values + level * rng.standard_normal(v.shape), 0, 255)) for v in (case.reference, case.deformed)
                ]
                pairs = candidates_of(noisy[0], noisy[1], counts, motion, reach=1.0 if motion is not None else 2.75)[0]
                for way in (None, *WAYS):
                    errors = match_errors(case, potential_matches(pairs, way))
                    seen.setdefault(way or "correlation alone", []).append((len(pairs), len(errors), float((errors < RIGHT_MM).sum())))
            for name, values in seen.items():
                n, m, right = np.mean(values, axis=0)
                rows.append(NoiseRow(level, motion is not None, name, float(n), float(m), float(right), 100.0 * float(right / m)))
    return rows
