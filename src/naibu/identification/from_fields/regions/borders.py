"""Borders of regions that run through cells: a low-order level set :cite:p:`osher1988`, and the moduli of cells that they cut.

A region consists of one or more pieces, each with a border of its own: two lumps of one material are two pieces. The border of every piece
but that of the largest region is moved along its normal by polynomials of degree two in the direction from its middle. It starts from the
cells of the piece, smoothed, or from the ball of their volume. Cells on borders are mixed in logarithms of moduli.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.regularization import cell_volumes

WINDOW = 0.8  # standard deviation, in cells, of the window in which cells are smoothed
REACH, NEIGHBOURS = 3.0, 64  # of that window, in standard deviations, and cells in it at most
INWARDS = 0.42  # way from a corner to the middle of a cell at which borders are evaluated, about that of Gauss points
SHARPNESS = 0.25  # standard deviation, in cells, over which a border is spread when cells are mixed
COMPACT = 0.6  # part of a region within the ball of its volume from which its border may start as a sphere
BISECTIONS = 30  # for the move of a border that keeps the volume


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Regions with borders that run through cells.

    Attributes
    ----------
    middles : ndarray, shape (m, 3)
        Middles of the cells, mm.
    volumes : ndarray, shape (m,)
        Their volumes, mm^3.
    piece_of_cell : ndarray, shape (m,), int64
        Piece of every cell, -1 where the moduli are known; 0 is the largest region.
    region_of_piece : ndarray, shape (pieces,), int64
        Region of every piece; that of piece 0, and of no other, is 0.
    moves : ndarray, shape (pieces - 1, 10)
        How far the borders of the other pieces move outwards, mm: coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz of the direction from
        the middle of the piece.
    edge_mm : float
        Edge length of the cells.
    round : ndarray, shape (pieces - 1,), bool
        Which of the other pieces are, without moves, balls of the volume of their cells.
    """

    middles: FloatArray
    volumes: FloatArray
    piece_of_cell: IntArray
    region_of_piece: IntArray
    moves: FloatArray
    edge_mm: float
    round: BoolArray
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.middles))

    @classmethod
    def of(cls, mesh: Mesh, zones: Zones, pieces: Zones | None = None) -> Borders:
        """Return the borders of regions made of whole cells, each in one piece, or as the zones `pieces` within them say."""
        volumes, pieces = cell_volumes(mesh), pieces or zones
        edge = float(np.median(volumes) ** (1.0 / 3.0))
        there = pieces.of_cell != KNOWN
        region_of_piece = np.zeros(pieces.count, dtype=np.int64)
        region_of_piece[pieces.of_cell[there]] = zones.of_cell[there]
        moves, round_off = np.zeros((pieces.count - 1, 10)), np.zeros(pieces.count - 1, dtype=bool)
        return cls(mesh.points[mesh.cells].mean(axis=1), volumes, pieces.of_cell, region_of_piece, moves, edge, round_off)

    @property
    def gather(self) -> FloatArray:
        """Which region (pieces, regions) every piece belongs to: 1 there, else 0."""
        return np.asarray(np.eye(int(self.region_of_piece.max()) + 1)[self.region_of_piece])

    def rounded(self) -> Borders:
        """Return the borders with those of compact pieces as spheres."""
        away = [np.linalg.norm(self.middles - middle, axis=1) < radius for middle, radius in self._balls()]
        own = [self.piece_of_cell == piece for piece in range(1, len(self.moves) + 1)]
        within = [self.volumes[o & a].sum() / self.volumes[o].sum() for o, a in zip(own, away, strict=True)]
        return replace(self, round=np.asarray(within) > COMPACT)

    def _balls(self) -> list[tuple[FloatArray, float]]:
        """Return middle and radius, mm, of the ball of the volume of every piece but the first."""
        own = [self.piece_of_cell == piece for piece in range(1, len(self.moves) + 1)]
        radii = [float((0.75 / np.pi * self.volumes[o].sum()) ** (1.0 / 3.0)) for o in own]
        return [(np.average(self.middles[o], weights=self.volumes[o], axis=0), r) for o, r in zip(own, radii, strict=True)]

    def distances(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how deep points (n, 3) lie in each piece but the first (n, pieces - 1), mm, and derivatives with respect to moves."""
        wide = WINDOW * self.edge_mm
        distance, near = self._tree.query(points, k=min(NEIGHBOURS, len(self.middles)), distance_upper_bound=REACH * wide)
        there = np.isfinite(distance)
        near = np.where(there, near, 0)
        weight = np.where(there, self.volumes[near] * np.exp(-0.5 * (np.where(there, distance, 0.0) / wide) ** 2), 0.0)
        total = np.maximum(weight.sum(axis=1), 1e-300)
        deep, modes = [], []
        for piece, (moves, ball, (middle, radius)) in enumerate(zip(self.moves, self.round, self._balls(), strict=True), start=1):
            if ball:
                plain = radius - np.linalg.norm(points - middle, axis=1)
            else:
                part = np.where((self.piece_of_cell == piece)[near], weight, 0.0).sum(axis=1) / total
                # the mean of a half-space in a Gaussian window is the normal distribution of the distance from its border
                plain = wide * np.clip(ndtri(np.clip(part, 1e-9, 1.0 - 1e-9)), -REACH, REACH)
            mode = _modes(points - middle)
            deep.append(plain + mode @ moves)
            modes.append(mode)
        return np.stack(deep, axis=1), np.stack(modes, axis=1)

    def with_moves(self, moves: FloatArray) -> Borders:
        """Return the borders where moves (pieces - 1, 10) put them."""
        return replace(self, moves=moves.reshape(self.moves.shape))

    def region_at(self, points: ArrayLike, otherwise: ArrayLike) -> IntArray:
        """Return the region of points (n, 3), mm, in cells of the regions `otherwise` (n,); known ones, -1, stay known."""
        given = np.asarray(otherwise, dtype=np.int64)
        deep, _ = self.distances(np.asarray(points, dtype=float))
        best = deep.argmax(axis=1)
        return np.where(given == KNOWN, KNOWN, self.region_of_piece[np.where(deep[np.arange(len(deep)), best] > 0.0, best + 1, 0)])


def _modes(away: FloatArray) -> FloatArray:
    """Return 1, x, y, z, xx, xy, xz, yy, yz, zz of directions (n, 3) as columns (n, 10); the diagonal squares less their mean."""
    x, y, z = (away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)).T
    third = 1.0 / 3.0
    return np.stack([np.ones_like(x), x, y, z, x * x - third, x * y, x * z, y * y - third, y * z, z * z - third], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Mixing:
    """Moduli of cells from those of regions with moved borders.

    Attributes
    ----------
    borders : Borders
        Borders of the regions.
    deep : ndarray, shape (cells, points, pieces - 1)
        How deep points of every cell lie in the pieces without moves, mm.
    modes : ndarray, shape (cells, points, pieces - 1, 10)
        Derivatives with respect to moves.
    edge_mm : float
        Edge length of the cells.
    """

    borders: Borders
    deep: FloatArray
    modes: FloatArray
    edge_mm: float

    @classmethod
    def at(cls, borders: Borders, mesh: Mesh, cells: IntArray, edge_mm: float) -> Mixing:
        """Return it for some cells of a mesh, of that edge length, mm."""
        corners = mesh.points[mesh.cells[cells]]
        points = corners + INWARDS * (corners.mean(axis=1, keepdims=True) - corners)
        deep, modes = replace(borders, moves=np.zeros_like(borders.moves)).distances(points.reshape(-1, 3))
        shape = points.shape[:2]
        return cls(borders, deep.reshape(*shape, -1), modes.reshape(*shape, *modes.shape[1:]), edge_mm)

    @classmethod
    def of(cls, model: FieldModel, borders: Borders) -> Mixing:
        """Return it for every zone of the model, each a single cell, with the borders moved so that volumes are those of the cells."""
        cells = np.flatnonzero(model.zones.of_cell != KNOWN)
        cells = cells[np.argsort(model.zones.of_cell[cells], kind="stable")]
        made, piece_of_cell = cls.at(borders, model.mesh, cells, borders.edge_mm), borders.piece_of_cell[cells]
        volume = borders.volumes[cells]
        whole = np.array([volume[piece_of_cell == piece].sum() for piece in range(1, len(borders.moves) + 1)])
        low, high = (np.full(len(whole), sign * REACH * borders.edge_mm) for sign in (-1.0, 1.0))
        for _ in range(BISECTIONS):
            moves = np.zeros_like(borders.moves)
            moves[:, 0] = 0.5 * (low + high)
            less = volume @ made.fractions(moves.ravel())[0] < whole
            low, high = np.where(less, moves[:, 0], low), np.where(less, high, moves[:, 0])
        return replace(made, borders=borders.with_moves(moves))

    def moduli(self, theta: FloatArray, moves: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta of the zones (2 zones,) and its derivatives (2 zones, 2 regions + moves)."""
        part, slope = self.fractions(moves)
        fractions, values = self._shares(part), theta.reshape(2, -1)
        jumps = values[:, self.borders.region_of_piece[1:]] - values[:, :1]
        of_moves = np.concatenate([(slope * jump[:, None]).reshape(len(slope), -1) for jump in jumps])
        return (fractions @ values.T).T.ravel(), np.column_stack([np.kron(np.eye(2), fractions), of_moves])

    def shares(self, moves: FloatArray) -> FloatArray:
        """Return the part of every zone in each region (zones, regions)."""
        return self._shares(self.fractions(moves)[0])

    def _shares(self, part: FloatArray) -> FloatArray:
        return np.asarray(np.column_stack([1.0 - part.sum(axis=1), part]) @ self.borders.gather)

    def fractions(self, moves: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the part of every zone in each piece but the first (zones, pieces - 1), and its derivatives (..., 10)."""
        wide = SHARPNESS * self.edge_mm
        deep = self.deep + np.einsum("zpra,ra->zpr", self.modes, moves.reshape(self.borders.moves.shape))
        share = ndtr(deep / wide)
        density = np.exp(-0.5 * (deep / wide) ** 2) / (wide * np.sqrt(2.0 * np.pi))
        crowd = np.maximum(share.sum(axis=2, keepdims=True), 1.0)  # pieces never fill more than the whole
        part = (share / crowd).mean(axis=1)
        return part, np.einsum("zpr,zpra->zra", density / crowd, self.modes) / deep.shape[1]
