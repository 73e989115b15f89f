"""Pairs of the two sides of cuts that open, close, stick or slip in a step, beside their stiffness in the tangent of an earlier state.

A tangent of then holds closed what was closed then. Pairs whose state has changed since, or may change, are taken out of it, and their
contact is solved as it is, condensed like that of indenters (`condensed_contact`). Without friction
only the approach of the two sides of a pair counts, so that all pairs that are near to each other take part: where a piece comes loose, as
behind cuts that cross, hundreds hover between open and closed, and steps that hold most of them in their state of before find no balance.
Friction is condensed to the nodes of the pairs, and has the stiffness of its secant in both; in the tangent, which is symmetric, without
its growth with pressure. Where it acts, all pairs that press or are near to it are taken out: what the others leave out of balance where
the motion turns round takes iterations of the whole body, and at last Newton's method.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray
from naibu.mechanics.contact._cut_lip_kernels import RAMP, pair_forces
from naibu.mechanics.contact.cut_lips import CutLips, across
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion, forces_along, relative
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, UpdatedFactors

MOST = 80  # pairs in a step whose nodes are condensed, without friction
AHEAD = 900  # pairs whose approach is condensed, at most
NEAR = 0.1  # of the edge: gaps, and penetrations, from which pairs are not expected to change
NEARING = 0.3  # of the edge: gaps from which pairs are not expected to close before there is another tangent
UNCHANGED = 5e-4  # of the largest change of the stiffness of a pair: what is left out
TURNED = 0.9  # cosine of the angle by which the normal of a pair may have turned since a tangent was made


@dataclass(slots=True, eq=False)
class LipsBesideTangent:
    """Change of the forces of pairs, less what an earlier tangent contains of it; used as `NearbyContact` is.

    Attributes
    ----------
    lips : CutLips
        These pairs, with normals.
    points : ndarray, shape (k,), int64
        Their numbers among all pairs.
    displacement : ndarray, shape (n, 3)
        From which the body moves, mm.
    earlier : ndarray, shape (k, 3, 3)
        Stiffness of the pairs in the tangent, mN/mm.
    exerted : float
        Sum of the components of the forces on both sides at the last evaluation, mN.
    """

    lips: CutLips
    points: IntArray
    displacement: FloatArray
    earlier: FloatArray
    exerted: float = field(init=False, default=0.0)
    _now: FloatArray = field(init=False)
    _before: FloatArray = field(init=False)  # internal forces on the first nodes (k, 3), mN
    _pairs: IntArray = field(init=False)  # their nodes as displacements number them
    _start: FloatArray = field(init=False)  # displacements of the second nodes less those of the first (k, 3), mm
    _begun: FloatArray = field(init=False)  # positions of the second nodes relative to the first (k, 3), mm
    _anchors: FloatArray = field(init=False)
    _overlaps: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._before, self._now = np.zeros((len(self.points), 3)), np.zeros((len(self.points), 3, 3))
        first, second = self.lips.pairs.T
        at_rest = self.lips.points[second] - self.lips.points[first]
        self._anchors = at_rest if self.lips.anchors is None else self.lips.anchors
        self._overlaps = np.zeros(len(self.points)) if self.lips.overlaps is None else self.lips.overlaps
        self._pairs, self._start = self.lips.pairs, self.displacement[second] - self.displacement[first]
        self._begun = at_rest + self._start
        self._evaluate(self._begun, self._before)

    def numbered(self, place: IntArray) -> LipsBesideTangent:
        """Return these pairs of nodes that are numbered anew: `place` (n,) has the new number of each."""
        anew = copy(self)
        anew._pairs = place[self.lips.pairs]
        return anew

    def _evaluate(self, relative: FloatArray, force: FloatArray) -> None:
        own = self.lips
        assert own.normals is not None
        pair_forces(relative, self._anchors, own.normals, self._overlaps, own.area, own.edge, own.stiffness, own.friction, force, self._now)

    def add_force(self, displacement: FloatArray, force: FloatArray) -> None:
        """Add the change of the forces up to a displacement (n, 3), mm, to `force` (n, 3), mN."""
        first, second = self._pairs.T
        moved = displacement[second] - displacement[first] - self._start
        change = np.empty_like(self._before)
        self._evaluate(self._begun + moved, change)
        self.exerted = 2.0 * float(np.abs(change).sum())
        change += np.einsum("pij,pj->pi", self.earlier, moved) - self._before
        np.subtract.at(force, first, change)
        np.add.at(force, second, change)

    def add_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add the difference of the stiffness at the last evaluation; `positions` (p, 2, 2) are those of all pairs in the pattern."""
        places = positions[self.points]
        for a in range(2):
            for b in range(2):
                np.add.at(blocks, places[:, a, b], (1.0 if a == b else -1.0) * (self._now - self.earlier))

    def add_secant_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add what `add_stiffness` adds: that of friction is its secant."""
        self.add_stiffness(pattern, positions, blocks)


def changing_lips(lips: CutLips, tangent: EarlierTangent, displacement: FloatArray, free: FloatArray) -> LipsBesideTangent:
    """Return the pairs that are, or may come to be, in another state than in a tangent.

    Parameters
    ----------
    lips : CutLips
        All pairs, with the normals of the step.
    tangent : EarlierTangent
        Which holds together what was closed then.
    displacement : ndarray, shape (n, 3)
        From which the body moves, mm.
    free : ndarray, shape (n, 3)
        How it would move by the tangent, mm.
    """
    before, after = lips.gaps(displacement), lips.gaps(displacement + free)
    then = tangent.lips.any(axis=(1, 2))
    known = np.asarray(tangent.factors.covered(lips.pairs).all(axis=1))
    changed = np.asarray((then != (before < 0.0)) | (known & (then != (after < 0.0))))
    of_approach = approaching(lips, tangent)
    known[of_approach] = changed[of_approach] = False
    close = np.minimum(np.abs(before), np.abs(after)) / lips.edge
    if lips.friction > 0.0:
        chosen = np.flatnonzero(changed | then | (close < NEAR)).astype(np.int64)
        return LipsBesideTangent(lips.only(chosen), chosen, displacement, tangent.lips[chosen])
    chosen = np.flatnonzero(changed | (known & (close < NEAR)))
    chosen = np.sort(chosen[np.lexsort((close[chosen], ~changed[chosen]))][:MOST]).astype(np.int64)
    return LipsBesideTangent(lips.only(chosen), chosen, displacement, tangent.lips[chosen])


def lips_about_to_change(lips: CutLips, displacement: FloatArray) -> IntArray:
    """Return the nodes (k,) of pairs that rub, and are near to each other at a displacement (n, 3), mm, the nearest first.

    Without friction they need not be prepared: see `pairs_along_normals`.
    """
    if lips.friction == 0.0:
        return np.zeros(0, dtype=np.int64)
    near = np.abs(lips.gaps(displacement)) / lips.edge
    order = np.argsort(near, kind="stable")
    return np.asarray(lips.pairs[order[near[order] < NEAR]].ravel(), dtype=np.int64)


def pairs_along_normals(lips: CutLips, factors: UpdatedFactors, displacement: FloatArray, held: IntArray) -> PairedMotion:
    """Return how the pairs that may open or close approach each other, by the factors of the tangent at a displacement (n, 3), mm.

    Nodes that are held (h,) do not move in it.
    """
    gap, normal = lips.gaps_and_normals(displacement)
    near = np.abs(gap) / lips.edge
    order = np.argsort(near, kind="stable")[:AHEAD]
    chosen = np.sort(order[near[order] < NEARING]).astype(np.int64)
    return PairedMotion.of(factors, chosen, lips.pairs[chosen], normal[chosen], held)


def approaching(lips: CutLips, tangent: EarlierTangent) -> IntArray:
    """Return the pairs (k,) whose approach is condensed: those that a tangent knows, and that have not turned by much since then."""
    known = tangent.pairs
    now = lips.normals
    assert now is not None
    turned = (now[known.numbers] * known.directions).sum(axis=1)
    return np.asarray(known.numbers[(turned > TURNED) | ~now[known.numbers].any(axis=1)])


@dataclass(slots=True, eq=False)
class ApproachingLips:
    """Forces across pairs beside those that an earlier tangent contains, at their approach along their normals.

    A tangent holds pairs along their normals of then, and how they move one another is known along these. That the normals have turned
    meanwhile changes the gap by as much as the sides slide, which hardly depends on what presses across them.

    Attributes
    ----------
    lips : CutLips
        The pairs that a tangent knows, in its order, with the normals of the step.
    active : ndarray, shape (p,), bool
        Which of them take part.
    normals, directions : ndarray, shape (p, 3)
        Normals now, and those of the tangent; zero where a pair takes no part.
    gap : ndarray, shape (p,)
        Where they are, mm; negative where they press.
    earlier : ndarray, shape (p,)
        Their stiffness in the tangent, mN/mm.
    """

    lips: CutLips
    active: BoolArray
    normals: FloatArray
    directions: FloatArray
    gap: FloatArray
    earlier: FloatArray
    exerted: float = field(init=False, default=0.0)
    _at: FloatArray = field(init=False)
    _turned: FloatArray = field(init=False)  # what gaps change by as normals have turned, mm

    @classmethod
    def of(cls, lips: CutLips, tangent: EarlierTangent, displacement: FloatArray) -> ApproachingLips:
        """Return the pairs of a tangent at a displacement (n, 3), mm."""
        known = tangent.pairs
        own = lips.only(known.numbers)
        earlier = np.einsum("pi,pij,pj->p", known.directions, tangent.lips[known.numbers], known.directions)
        active = np.isin(known.numbers, approaching(lips, tangent))
        assert own.normals is not None
        facing = np.asarray(own.normals.any(axis=1))
        along = np.where(facing[:, None], own.normals, known.directions)
        now, then = (np.where(active[:, None], unit, 0.0) for unit in (along, known.directions))
        return cls(own, active, now, then, own.gaps(displacement), earlier)

    def __post_init__(self) -> None:
        self._at, self._turned = np.zeros(len(self.gap)), np.zeros(len(self.gap))

    def motion(self, displacement: FloatArray) -> FloatArray:
        """Return by how much the sides of each pair go apart along the normals of the tangent (p,), mm, from displacements (n, 3), mm."""
        return relative(displacement.ravel(), self.lips.pairs, self.directions)

    def now(self, n_points: int) -> FloatArray:
        """Return the forces (3 n,), mN, that the pairs exert on the nodes of the body where they are."""
        return forces_along(self._across(self.gap), self.lips.pairs, self.normals, n_points)

    def slide(self, displacement: FloatArray) -> None:
        """Have the sides slide as nodes are displaced (n, 3), mm."""
        self._turned = relative(displacement.ravel(), self.lips.pairs, self.normals - self.directions)

    def forces(self, apart: FloatArray) -> FloatArray:
        """Return the forces (p,), mN, that part the sides, where they have gone apart (p,), mm, less what the tangent adds to them."""
        self._at = self.gap + self._turned + apart
        pressing = self._across(self._at)
        self.exerted = 2.0 * float(pressing @ np.abs(self.normals).sum(axis=1))
        return np.asarray(np.where(self.active, pressing + self.earlier * apart, 0.0))

    def on_nodes(self, amounts: FloatArray, apart: FloatArray, held: IntArray, n_points: int) -> FloatArray:
        """Return the forces (3 n,), mN, on the nodes of the body, of which some (h,) are held, of those on pairs.

        Both the forces of pairs and their motion, mm, are in rows of three.
        """
        many = len(self.gap)
        of_tangent = np.where(self.active, self.earlier * apart.ravel()[:many], 0.0)
        force = forces_along(of_tangent, self.lips.pairs, self.directions, n_points)
        force += forces_along(amounts.ravel()[:many] - of_tangent, self.lips.pairs, self.normals, n_points)
        force.reshape(-1, 3)[held] = 0.0
        return force

    def change(self) -> FloatArray:
        """Return the stiffness (p,), mN/mm, at the last forces, less that of the tangent."""
        ramp = RAMP * self.lips.edge
        slope = np.clip(-np.minimum(self._at, 0.0) / ramp, 0.0, 1.0) * self.lips.stiffness * self.lips.area
        return np.asarray(np.where(self.active, slope - self.earlier, 0.0))

    def opened(self) -> FloatArray:
        """Return what `change` would be if no pair touched."""
        return np.where(self.active, -self.earlier, 0.0)

    def _across(self, gap: FloatArray) -> FloatArray:
        return across(gap, self.lips.area, self.lips.edge, self.lips.stiffness)


def in_threes(amounts: FloatArray) -> FloatArray:
    """Return amounts (p,) as rows of three (ceil(p / 3), 3), as those of nodes; zeros behind the last."""
    out = np.zeros((-(-len(amounts) // 3), 3))
    out.ravel()[: len(amounts)] = amounts
    return out


def motion_in_threes(sides: ApproachingLips | None, motion: FloatArray) -> list[FloatArray]:
    """Return by how much pairs go apart as nodes move (n, 3), mm, in rows of three; nothing where there are no pairs."""
    return [] if sides is None else [in_threes(sides.motion(motion))]


def change_in_threes(change: FloatArray, first: int) -> BlockChange:
    """Return the change of stiffnesses (p,), mN/mm, as that of rows of three, of which row `first` is the first one."""
    rows = in_threes(change)
    rows[np.abs(rows) <= UNCHANGED * np.abs(rows).max(initial=0.0)] = 0.0
    some = np.flatnonzero(rows.any(axis=1))
    places = np.arange(len(some))
    return BlockChange(first + some, places, places, rows[some][:, :, None] * np.eye(3))
