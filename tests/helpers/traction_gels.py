"""Particles in a hydrogel around cells that pull at it, as a confocal microscope finds them: a displacement that decays within a few."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from marker_scenes import Array, Cloud
from particle_gels import NOISE_PX, SPACING_PX, depth_dependent_loss

POISSON = 0.45
LEAST_VOLUME = 0.12  # ratio of volumes below which the forces are lowered


@dataclass(frozen=True)
class Adhesions:
    """Forces (k, 3) at points (k, 3), spread over a distance, px, in an elastic space whose shear modulus is in the unit of the forces."""

    points: Array
    forces: Array
    spread_px: float

    def displacement(self, x: Array) -> Array:
        """Displacement (n, 3), px: Kelvin's solution of regularised forces."""
        u = np.zeros_like(x)
        for at, force in zip(self.points, self.forces, strict=True):
            r = x - at
            length = np.sqrt(np.sum(r**2, axis=1) + self.spread_px**2)[:, None]
            u += (3.0 - 4.0 * POISSON + (self.spread_px / length) ** 2) * force / length + r * (r @ force)[:, None] / length**3
        return u

    def gradient(self, x: Array, step_px: float = 0.05) -> Array:
        """Displacement gradient (n, 3, 3) by central differences."""
        steps = step_px * np.eye(3)
        return np.stack([(self.displacement(x + h) - self.displacement(x - h)) / (2.0 * step_px) for h in steps], axis=2)

    def scaled(self, factor: float) -> Adhesions:
        return Adhesions(self.points, factor * self.forces, self.spread_px)


@dataclass(frozen=True)
class TractionGel:
    """A cloud, its motion, and the displacement of every reference particle by the cells, in spacings (0 of spurious ones)."""

    cloud: Cloud
    adhesions: Adhesions
    turn: Array
    shift_px: Array
    size_px: Array

    def moved(self, x: Array) -> Array:
        """Positions (n, 3), px: pulled, turned about the middle, and shifted."""
        return np.asarray((x + self.adhesions.displacement(x) - self.size_px / 2) @ self.turn.T + self.size_px / 2 + self.shift_px)

    def gradient(self, x: Array) -> Array:
        """Gradient (n, 3, 3) of the displacement."""
        return np.asarray(self.turn @ (np.eye(3) + self.adhesions.gradient(x)) - np.eye(3))


def pulling_cells(rng: np.random.Generator, size: Array, cells: int, spread_px: float) -> Adhesions:
    """Cells with three adhesions at each end, which pull towards the middle."""
    points, forces = [], []
    for _ in range(cells):
        centre, axis = rng.uniform(0.15, 0.85, 3) * size, rng.standard_normal(3)
        axis *= rng.uniform(3.0, 6.0) * SPACING_PX / np.linalg.norm(axis)
        for end in (axis, -axis):
            for _ in range(3):
                at = centre + end + SPACING_PX * rng.standard_normal(3)
                points.append(at)
                forces.append(rng.uniform(0.5, 1.0) * (centre - at) / np.linalg.norm(centre - at))
    return Adhesions(np.array(points), np.array(forces), spread_px)


def traction_gel(
    n: int,
    seed: int,
    *,
    cells: int = 2,
    peak: float = 3.0,
    decay: float = 4.0,
    loss: float = 0.5,
    spurious: float = 0.1,
    degrees: float = 0.0,
    shift: float = 5.0,
) -> TractionGel:
    """Scatter n particles in a block of 2 x 2 x 1 and let cells pull; noise, losses and spurious particles as in `particle_gels`.

    The largest displacement `peak` and the spread `decay` of an adhesion's force are in spacings; so is `shift`.
    """
    rng = np.random.default_rng(seed)
    size = SPACING_PX * (n / 4.0) ** (1.0 / 3.0) * np.array([2.0, 2.0, 1.0])
    x = rng.uniform(0.0, size, (n, 3))
    adhesions = pulling_cells(rng, size, cells, decay * SPACING_PX)
    pulled = np.linalg.norm(adhesions.displacement(x), axis=1)
    adhesions = adhesions.scaled(peak * SPACING_PX / pulled.max())
    hardest = x[np.argsort(pulled)[-2000:]]
    while np.linalg.det(np.eye(3) + adhesions.gradient(hardest)).min() < LEAST_VOLUME:
        adhesions = adhesions.scaled(0.95)
    axis, direction = rng.standard_normal((2, 3))
    k = np.cross(np.eye(3), axis / np.linalg.norm(axis))
    angle = np.radians(degrees)
    turn = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k
    shift_px = shift * SPACING_PX * direction / np.linalg.norm(direction)
    gel = TractionGel(Cloud(x, x, np.zeros(0), np.zeros(0)), adhesions, turn, shift_px, size)
    depth = 1.0 - x[:, 2] / size[2]
    there = np.flatnonzero(rng.uniform(size=n) >= depth_dependent_loss(depth, loss))

    def noisy(points: Array, below: Array) -> Array:
        return np.asarray(points + np.array(NOISE_PX) * (0.5 + below)[:, None] * rng.standard_normal(points.shape))

    false = rng.uniform(0.0, size, (int(spurious * n), 3))
    others = gel.moved(rng.uniform(0.0, size, (int(spurious * len(there)), 3)))
    deformed = np.concatenate([noisy(gel.moved(x), depth)[there], others])
    order, mixed = rng.permutation(len(deformed)), rng.permutation(n + len(false))
    truth = np.full(n + len(false), -1)
    truth[there] = np.argsort(order)[: len(there)]
    by_cells = np.concatenate([np.linalg.norm(adhesions.displacement(x), axis=1) / SPACING_PX, np.zeros(len(false))])
    cloud = Cloud(np.concatenate([noisy(x, depth), false])[mixed], deformed[order], truth[mixed], by_cells[mixed])
    return TractionGel(cloud, adhesions, turn, shift_px, size)
