"""Contacts condensed to their nodes: closed solutions of springs before a wall."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import nnls

from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_strain.sessions.tangents.condensed_contact import UNAIDED, CondensedContact
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, ChangedInverse, UpdatedFactors

BODY, WALL, GAP = 10.0, 1e4, 0.5  # mN/mm, mN/mm, mm


class Wall:
    """A wall across z, at a gap above all nodes, that pushes and does not pull."""

    slips = False

    def __init__(self) -> None:
        self.deep, self.exerted = np.zeros(0), 0.0

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.deep = np.maximum(motion[:, 2] - GAP, 0.0)
        self.exerted = WALL * float(self.deep.sum())
        return np.column_stack([np.zeros((len(motion), 2)), -WALL * self.deep])

    def change(self, *, exact: bool = False) -> BlockChange:
        assert not exact
        nodes = np.flatnonzero(self.deep > 0.0)
        places = np.arange(len(nodes))
        return BlockChange(nodes, places, places, np.tile(WALL * np.diag([0.0, 0.0, 1.0]), (len(nodes), 1, 1)))

    def opened(self) -> BlockChange:
        none = np.zeros(0, np.int64)
        return BlockChange(none, none, none, np.zeros((0, 3, 3)))


class RoughWall:
    """A wall across z at z = 0 with Coulomb friction: tangential penalties up to a limit that grows with the pressure."""

    slips = True

    def __init__(self, friction: float, tangential: float) -> None:
        self.friction, self.tangential, self.changes, self.last, self.exerted = friction, tangential, 0, np.zeros((0, 3)), 0.0

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.last = motion.copy()
        pressure = WALL * np.maximum(motion[:, 2], 0.0)
        trial = -self.tangential * motion[:, :2]
        size = np.linalg.norm(trial, axis=1)
        limit = self.friction * pressure
        force = np.column_stack([trial * (np.minimum(size, limit) / np.maximum(size, 1e-300))[:, None], -pressure])
        self.exerted = float(np.abs(force).sum())
        return force

    def change(self, *, exact: bool = False) -> BlockChange:
        self.changes += 1
        nodes = np.flatnonzero(self.last[:, 2] > 0.0)
        blocks = np.zeros((len(nodes), 3, 3))
        for block, motion in zip(blocks, self.last[nodes], strict=True):
            size = float(np.linalg.norm(motion[:2]))
            limit = self.friction * WALL * motion[2]
            block[2, 2] = WALL
            block[:2, :2] = self.tangential * np.eye(2)
            if self.tangential * size > limit:
                along = np.outer(motion[:2], motion[:2]) / size**2 if exact else 0.0
                block[:2, :2] = limit / size * (np.eye(2) - along)
                block[:2, 2] = self.friction * WALL * motion[:2] / size
        places = np.arange(len(nodes))
        return BlockChange(nodes, places, places, blocks)

    def opened(self) -> BlockChange:
        none = np.zeros(0, np.int64)
        return BlockChange(none, none, none, np.zeros((0, 3, 3)))


def found_by(search: Generator[None, None, FloatArray]) -> FloatArray:
    """What a search finds that is never interrupted."""
    while True:
        try:
            next(search)
        except StopIteration as end:
            return np.asarray(end.value)


def factorized(matrix: FloatArray) -> EarlierTangent:
    """The tangent of a body without contact."""
    solver = SuperLUSolver()
    factors = UpdatedFactors(solver.factorize(sp.bsr_matrix(matrix, blocksize=(3, 3))), len(matrix) // 3)
    none, still = np.zeros(0, np.int64), np.zeros((len(matrix) // 3, 3))
    return EarlierTangent(factors, np.zeros((0, 0, 3)), np.zeros((0, 3, 3)), none, none, np.zeros((0, 3, 3)), solver, still)


@pytest.mark.parametrize("friction", [0.3, 1.0, 2.0])
def test_a_chain_of_points_that_stick_and_slip_is_solved_with_few_derivatives(friction: float) -> None:
    """Pressed on alike and drawn sideways unevenly: some points stick, others slip; y = free + W g(y) is checked as it stands."""
    count = 12
    springs = BODY * (2.2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    tangent, nodes = factorized(np.kron(springs, np.eye(3))), np.arange(count)
    free = np.column_stack([np.linspace(0.0, 4.0, count), 0.5 * np.cos(np.arange(count)), 0.5 + 0.4 * np.sin(2.0 * np.arange(count))])
    law = RoughWall(friction, 1e4)
    force = found_by(CondensedContact(tangent, nodes, np.full(count, BODY)).forces(free, law, np.zeros_like(free), 1e-6, 10.0, 1e-3))
    assert law.changes <= 8
    reached = free + np.linalg.solve(np.kron(springs, np.eye(3)), force.ravel()).reshape(-1, 3)
    sideways, limit = np.linalg.norm(force[:, :2], axis=1), -friction * force[:, 2]
    assert (force[:, 2] <= 0.0).all()
    assert (sideways <= limit * (1.0 + 1e-9) + 1e-9).all()
    slipping = sideways > 0.999 * limit
    sticking = (limit > 0.0) & ~slipping
    assert np.linalg.norm(reached[sticking, :2], axis=1).max(initial=0.0) <= limit.max() / 1e4 + 1e-4  # elastic slip at most
    np.testing.assert_allclose(force[:, 2], -WALL * np.maximum(reached[:, 2], 0.0), atol=2e-2 * BODY)
    opposite = (force[slipping, :2] * reached[slipping, :2]).sum(axis=1)
    assert (opposite <= 0.0).all()


@pytest.mark.parametrize("seed", [1, 6, 11])
def test_points_that_all_move_one_another_stick_and_slip_in_balance(seed: int) -> None:
    """Every point moves all others; y = free + W g(y) is checked as it stands, where secants of friction alone find no balance."""
    count, rng = 30, np.random.default_rng(seed)
    root = rng.normal(size=(3 * count, 3 * count))
    stiffness = BODY * (0.3 * np.eye(3 * count) + root @ root.T / count)
    free = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(-0.2, 1.0, count)])
    body, law = CondensedContact(factorized(stiffness), np.arange(count), np.full(count, BODY)), RoughWall(0.6, 1e4)
    force = found_by(body.forces(free, law, free, 1e-4, 3.0, 1e-6))
    motion = free + np.linalg.solve(stiffness, force.ravel()).reshape(-1, 3)
    assert body.balanced
    assert np.abs(law(motion) - force).sum() < 0.005 * np.abs(force).sum()


def test_points_of_stiff_and_soft_bodies_that_stick_and_slip_by_turns_find_their_forces() -> None:
    """Bodies with stiffnesses from 1 to 1000 mN/mm in random directions; searched steps of Newton's method solve 26 of these 40."""
    solved = 0
    for seed in range(40):
        chance = np.random.default_rng(seed)
        axes = np.linalg.qr(chance.normal(size=(36, 36)))[0]
        body = axes @ np.diag(10.0 ** chance.uniform(0.0, 3.0, 36)) @ axes.T
        free = np.column_stack([chance.normal(0.0, 2.0, (12, 2)), chance.normal(0.5, 1.0, 12)])
        condensed = CondensedContact(factorized(body), np.arange(12), np.full(12, 100.0))
        force = found_by(condensed.forces(free, RoughWall(0.3, 1e4), np.zeros_like(free), 1e-5, 10.0, 1e-3))
        reached = free + np.linalg.solve(body, force.ravel()).reshape(-1, 3)
        solved += bool(np.abs(force - RoughWall(0.3, 1e4)(reached)).max() < 0.05 * np.abs(force).max())
    assert solved >= 34


class RoundedWall(Wall):
    """The same, at motions that are known to a millionth of a millimetre only: as where the motion of a body as a whole is large."""

    def __init__(self) -> None:
        super().__init__()
        self.evaluations, self.changes = 0, 0

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.evaluations += 1
        return super().__call__(motion + 1e-6 * np.sin(1e9 * motion))

    def change(self, *, exact: bool = False) -> BlockChange:
        self.changes += 1
        return super().change(exact=exact)


def test_a_search_ends_where_only_rounding_is_left() -> None:
    """A light body lies on a stiff wall: forces differ by more than they should, and no evaluation or matrix makes that less."""
    count, weight = 12, 0.5  # mN
    condensed = CondensedContact(factorized(BODY * np.eye(3 * count)), np.arange(count), np.full(count, BODY))
    free, law = np.tile([0.0, 0.0, GAP + weight / BODY], (count, 1)), RoundedWall()
    force = found_by(condensed.forces(free, law, np.zeros_like(free), 0.05, 10.0, 1e-9))
    assert law.changes <= 3 and law.evaluations <= 20
    np.testing.assert_allclose(force[:, 2], -weight, atol=0.02)  # of a stiffness of 1e4 mN/mm


class RoughWallOfThen(RoughWall):
    """The same, beside a tangent in which all nodes touched it: they are those that springs hold back where no forces are found."""

    def opened(self) -> BlockChange:
        places = np.arange(len(self.last))
        return BlockChange(places, places, places, np.zeros((len(places), 3, 3)))


def test_points_that_were_held_back_are_let_go_again() -> None:
    """The soft bodies slide far: what springs, of 100 mN/mm here, took from the balance was left to the iterations of the whole body."""
    solved = 0
    for seed in range(40):
        chance = np.random.default_rng(100 + seed)
        axes = np.linalg.qr(chance.normal(size=(36, 36)))[0]
        body = axes @ np.diag(10.0 ** chance.uniform(0.0, 3.0, 36)) @ axes.T
        free = np.column_stack([chance.normal(0.0, 2.0, (12, 2)), chance.normal(0.5, 1.0, 12)])
        condensed = CondensedContact(factorized(body), np.arange(12), np.full(12, 100.0))
        force = found_by(condensed.forces(free, RoughWallOfThen(0.3, 1e4), np.zeros_like(free), 1e-5, 10.0, 1e-3, 12, UNAIDED))
        reached = free + np.linalg.solve(body, force.ravel()).reshape(-1, 3)
        solved += bool(np.abs(force - RoughWall(0.3, 1e4)(reached)).max() < 0.05 * np.abs(force).max())
    assert solved >= 34


@pytest.mark.parametrize("begin", [0.0, 3.0])
def test_springs_stop_at_a_wall_or_do_not_reach_it(begin: float) -> None:
    tangent = factorized(BODY * np.eye(12))
    free = np.array([[0.0, 0.0, 2.0], [0.0, 0.3, 0.4], [0.1, 0.0, -4.0]])
    condensed = CondensedContact(tangent, np.array([0, 2, 3]), np.full(3, BODY))
    force = found_by(condensed.forces(free, Wall(), np.full((3, 3), begin), 1e-5, 1.0, 1e-3))
    # in equilibrium: BODY (free - y) = WALL (y - GAP)
    stopped = (BODY * 2.0 + WALL * GAP) / (BODY + WALL)
    np.testing.assert_allclose(force[:, 2], [-BODY * (2.0 - stopped), 0.0, 0.0], atol=0.2)
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-6)
    none = np.zeros(0, np.int64)
    assert condensed.serves(tangent, np.array([2, 3]), none)
    assert not condensed.serves(tangent, np.array([1, 2]), none)
    assert not condensed.serves(tangent, np.array([2, 3]), np.array([1]))


def test_gripped_nodes_stay_and_the_others_move_as_those_of_a_body_that_is_held_there() -> None:
    """A chain before a wall with two nodes held fast, and its dense matrix without their rows and columns."""
    count, held = 8, np.array([2, 6])
    springs = BODY * (2.2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    body, moving = np.kron(springs, np.eye(3)), np.setdiff1d(np.arange(count), held)
    load = np.column_stack([np.linspace(-3.0, 3.0, count), np.ones(count), 4.0 + 6.0 * np.cos(np.arange(count))])
    whole = np.linalg.solve(body, load.ravel()).reshape(-1, 3)
    condensed = CondensedContact(factorized(body), moving, np.full(len(moving), BODY), held)
    alone = condensed.held(whole[moving], whole[held])
    at = (3 * moving[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(alone.ravel(), np.linalg.solve(body[np.ix_(at, at)], load[moving].ravel()), atol=1e-5)
    force = np.zeros((count, 3))
    force[moving] = found_by(condensed.forces(alone, Wall(), np.zeros_like(alone), 1e-6, 10.0, 1e-3))
    force[held] = condensed.holding(whole[held], force[moving])
    reached = whole + np.linalg.solve(body, force.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(reached[held], 0.0, atol=1e-5)
    assert force[moving, 2].min() < -0.1
    np.testing.assert_allclose(force[moving, 2], -WALL * np.maximum(reached[moving, 2] - GAP, 0.0), atol=0.02 * np.abs(force).max())


def test_springs_beside_a_change_hold_the_nodes_back() -> None:
    """Solutions with a change and springs are those of the dense matrix; one node has both, one a spring alone, one neither."""
    body, k = BODY * np.eye(9) + np.ones((9, 9)), np.array([2.0, 5.0, 0.0])
    place = np.array([0])
    change = BlockChange(place, place, place, np.array([[[4.0, 1.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 7.0]]]))
    inverse = np.asfortranarray(np.linalg.inv(body), dtype=np.float32)
    right = np.random.default_rng(1).normal(size=(3, 3))
    dense = np.diag(np.repeat(k, 3))
    dense[:3, :3] += change.blocks[0]
    expected = np.linalg.solve(body + dense, body @ right.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(ChangedInverse.of(inverse, change.with_springs(k)).solve(right), expected, rtol=1e-4, atol=1e-5)


class SoftWall(Wall):
    """A wall at a gap above all nodes whose pressure rises with the square of the penetration at first."""

    RAMP = 0.01  # mm

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.deep = np.maximum(motion[:, 2] - GAP, 0.0)
        ramp = np.where(self.deep < self.RAMP, 0.5 * self.deep**2 / self.RAMP, self.deep - 0.5 * self.RAMP)
        self.exerted = WALL * float(ramp.sum())
        return np.column_stack([np.zeros((len(motion), 2)), -WALL * ramp])

    def change(self, *, exact: bool = False) -> BlockChange:
        nodes = np.flatnonzero(self.deep > 0.0)
        slope = WALL * np.minimum(self.deep[nodes] / self.RAMP, 1.0)
        places = np.arange(len(nodes))
        return BlockChange(nodes, places, places, slope[:, None, None] * np.diag([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("pressed", [1e-3, 1e-2, 1.0, 100.0])
def test_light_contact_is_balanced_as_well_as_heavy_contact(pressed: float) -> None:
    """A motion of 1e-3 mm is 10 mN at the wall: far more than a body weighs that lies on it lightly."""
    tangent = factorized(BODY * np.eye(9))
    free = np.array([[0.0, 0.0, GAP + pressed / BODY], [0.0, 0.0, GAP + 2.0 * pressed / BODY], [0.0, 0.0, 0.0]])
    condensed = CondensedContact(tangent, np.arange(3), np.full(3, BODY))
    force = found_by(condensed.forces(free, SoftWall(), np.zeros((3, 3)), 1e-3, 10.0, 1e-6))
    reached = free + force / BODY
    np.testing.assert_allclose(force, SoftWall()(reached), atol=0.02 * np.abs(force).sum())
    assert force[0, 2] < 0.0


class Sides:
    """Pairs that resist their approach beyond a gap, in rows of three."""

    slips = False

    def __init__(self, gap: FloatArray) -> None:
        self.gap, self.deep, self.exerted = gap, np.zeros_like(gap), 0.0

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.deep = np.maximum(-(self.gap + motion), 0.0)
        self.exerted = WALL * float(self.deep.sum())
        return WALL * self.deep

    def change(self, *, exact: bool = False) -> BlockChange:
        rows = np.flatnonzero((self.deep > 0.0).any(axis=1))
        places = np.arange(len(rows))
        return BlockChange(rows, places, places, WALL * (self.deep[rows] > 0.0)[:, :, None] * np.eye(3))

    def opened(self) -> BlockChange:
        none = np.zeros(0, np.int64)
        return BlockChange(none, none, none, np.zeros((0, 3, 3)))


@pytest.mark.parametrize("seed", range(6))
def test_pairs_that_open_and_close_at_once_are_those_of_the_quadratic_programme(seed: int) -> None:
    random, count = np.random.default_rng(seed), 90
    springs = random.standard_normal((count, count))
    inverse = springs @ springs.T / count**2 + 1e-4 * np.eye(count)  # loose pieces: few motions that are a thousand times as free
    still, gap = random.standard_normal(count), 0.05 * random.random(count)
    tangent, none = factorized(BODY * np.eye(3)), np.zeros(0, np.int64)
    nowhere = np.zeros((count, 0), dtype=np.float32)
    pairs = PairedMotion(np.arange(count), np.zeros((count, 2), np.int64), np.zeros((count, 3)), inverse.astype(np.float32), nowhere)
    contact = CondensedContact(replace(tangent, pairs=pairs), none, np.full(count // 3, BODY))
    found = found_by(contact.forces(still.reshape(-1, 3), Sides(gap.reshape(-1, 3)), np.zeros((count // 3, 3)), 1e-5, 1e9, 1e-6))
    root = np.linalg.cholesky(inverse + np.eye(count) / WALL).T  # least of |root f + root^-T (gap + still)|, f not negative
    expected = nnls(root, -np.linalg.solve(root.T, gap + still), maxiter=100 * count)[0]
    np.testing.assert_allclose(found.ravel(), expected, atol=2e-3 * expected.max())
    assert contact.balanced


class LeapingSides(Sides):
    """Pairs whose forces leap where they meet: what presses less has no balance, and is left however many matrices are made."""

    changes = 0

    def __call__(self, motion: FloatArray) -> FloatArray:
        pushed = super().__call__(motion)
        return np.asarray(pushed + 50.0 * (self.deep > 0.0))

    def change(self, *, exact: bool = False) -> BlockChange:
        self.changes += 1
        return super().change(exact=exact)


def test_steps_end_where_they_no_longer_change_what_is_left() -> None:
    count, sides = 3, LeapingSides(np.full((1, 3), 0.5))
    tangent, none = factorized(BODY * np.eye(3)), np.zeros(0, np.int64)
    inverse, nowhere = np.eye(count, dtype=np.float32) / BODY, np.zeros((count, 0), dtype=np.float32)
    pairs = PairedMotion(np.arange(count), np.zeros((count, 2), np.int64), np.zeros((count, 3)), inverse, nowhere)
    contact = CondensedContact(replace(tangent, pairs=pairs), none, np.full(1, BODY))
    found_by(contact.forces(np.full((1, 3), -2.0), sides, np.zeros((1, 3)), 1e-5, 1e9, 1e-6))
    assert not contact.balanced
    assert sides.changes <= 8
