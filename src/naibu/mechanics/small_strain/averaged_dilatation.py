"""Stiffness of bilinear quadrilaterals (plane strain, axisymmetric) and hexahedra with an averaged dilatation, small strain.

The dilatation of a cell is its mean over the cell (the B-bar method of :cite:t:`hughes2000`), which keeps nearly incompressible solids from
locking. A cell is a brick: its sides are parallel to the axes, as those of layered grids are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError

Kinematics = Literal["plane_strain", "axisymmetric", "three_dimensional"]


@dataclass(frozen=True, slots=True, eq=False)
class BrickGrid:
    """A grid of bricks between planes.

    Attributes
    ----------
    planes : tuple of ndarray
        Increasing positions of the planes along each axis, mm: x, y in plane strain; radius, height if axisymmetric; x, y, z.
    kinematics : {"plane_strain", "axisymmetric", "three_dimensional"}
        Meaning of the axes.
    points : ndarray, shape (n, d)
        Nodes, mm; the last axis varies fastest.
    cells : ndarray, shape (m, 2**d), int64
        Nodes of every brick.
    gradients : ndarray, shape (m, q, 2**d, d)
        Gradients of the shape functions at the 2**d integration points, 1/mm.
    over_radius : ndarray, shape (m, q, 2**d)
        Shape functions divided by the radius, 1/mm: the hoop strain of a radial displacement; zero unless axisymmetric.
    weights : ndarray, shape (m, q)
        Volume of every integration point, mm^3; in plane strain for a thickness of 1 mm.
    """

    planes: tuple[FloatArray, ...]
    kinematics: Kinematics
    points: FloatArray
    cells: IntArray
    gradients: FloatArray
    over_radius: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, planes: tuple[FloatArray, ...], kinematics: Kinematics) -> BrickGrid:
        """Return the grid between planes.

        Raises
        ------
        InputError
            Planes that do not increase, or whose number does not fit the kinematics.
        """
        d = 3 if kinematics == "three_dimensional" else 2
        if len(planes) != d:
            raise InputError(f"planes must be given along {d} axes for kinematics={kinematics!r}, not {len(planes)}")
        planes = tuple(np.asarray(p, dtype=float) for p in planes)
        for axis, p in enumerate(planes):
            if p.ndim != 1 or len(p) < 2 or not np.isfinite(p).all() or not (np.diff(p) > 0.0).all():
                raise InputError(f"planes along axis {axis} must be two or more numbers, mm, that increase")
        if kinematics == "axisymmetric" and planes[0][0] < 0.0:
            raise InputError(f"planes along the radius must not be negative; the first is {planes[0][0]:g} mm")
        points = np.stack([c.ravel() for c in np.meshgrid(*planes, indexing="ij")], axis=1)
        number = np.arange(len(points)).reshape([len(p) for p in planes])
        corners = list(product((0, 1), repeat=d))
        cells = np.stack([number[tuple(slice(c, len(p) - 1 + c) for c, p in zip(k, planes, strict=True))].ravel() for k in corners], axis=1)
        size = points[cells[:, -1]] - points[cells[:, 0]]
        at = (1.0 + np.array(corners) * 2.0 / np.sqrt(3.0) - 1.0 / np.sqrt(3.0)) / 2.0  # Gauss points of the unit brick
        factor = np.stack([np.where(np.array(k) == 1, at, 1.0 - at) for k in corners], axis=1)  # (q, corner, axis)
        shapes = factor.prod(axis=2)
        sign = 2.0 * np.array(corners) - 1.0
        slopes = np.stack([sign[None, :, a] * np.delete(factor, a, axis=2).prod(axis=2) for a in range(d)], axis=2)
        weights = np.repeat(size.prod(axis=1)[:, None] / len(at), len(at), axis=1)
        over_radius = np.zeros((len(cells), len(at), len(corners)))
        if kinematics == "axisymmetric":
            radius = points[cells[:, 0], 0][:, None] + at[None, :, 0] * size[:, :1]
            weights = weights * 2.0 * np.pi * radius
            over_radius = shapes[None] / radius[:, :, None]
        return cls(planes, kinematics, points, cells.astype(np.int64), slopes[None] / size[:, None, None, :], over_radius, weights)

    @property
    def centres(self) -> FloatArray:
        """Centres of the cells (m, d), mm."""
        return np.asarray(self.points[self.cells].mean(axis=1))

    @property
    def volumes(self) -> FloatArray:
        """Volumes of the cells (m,), mm^3."""
        return np.asarray(self.weights.sum(axis=1))

    def mean_divergence(self) -> sp.csr_matrix:
        """Return the matrix (m, n d) that gives the mean dilatation of every cell for a displacement of the nodes."""
        return self._scattered(self._dilatation_rows()[:, None, :])

    def stiffness(self, lame_lambda: FloatArray, shear_modulus: FloatArray) -> sp.csr_matrix:
        """Return the stiffness (n d, n d), mN/mm, for Lame's constants (m,) of the cells, kPa."""
        m, q, k, d = self.gradients.shape
        g, h, w = self.gradients, self.over_radius, self.weights
        mean = self._dilatation_rows()
        inner = np.einsum("mq,mqic,mqlc->mil", w, g, g)
        shear = np.einsum("mil,ab->mialb", inner, np.eye(d)) + np.einsum("mq,mqib,mqla->mialb", w, g, g)
        shear[:, :, 0, :, 0] += 2.0 * np.einsum("mq,mqi,mql->mil", w, h, h)
        # 2 mu (e:e - theta^2/3) with the strain of each point, (lambda + 2 mu/3) theta^2 with the mean dilatation
        flat = g.copy()
        flat[..., 0] += h
        flat = flat.reshape(m, q, k * d)
        volumetric = np.einsum("m,mi,ml->mil", self.volumes, mean, mean)
        local = np.einsum("mq,mqi,mql->mil", w, flat, flat)
        matrix = shear_modulus[:, None, None] * (shear.reshape(m, k * d, k * d) - 2.0 / 3.0 * local)
        matrix += (lame_lambda + 2.0 / 3.0 * shear_modulus)[:, None, None] * volumetric
        index = (self.cells[:, :, None] * d + np.arange(d)).reshape(m, k * d)
        rows, columns = np.repeat(index, k * d, axis=1).ravel(), np.tile(index, (1, k * d)).ravel()
        n = len(self.points) * d
        return sp.csr_matrix((matrix.ravel(), (rows, columns)), shape=(n, n))

    def lumped_mass(self, density: FloatArray) -> FloatArray:
        """Return the mass of the nodes (n,), kg, for the density of the cells (m,), kg/mm^3."""
        k = self.cells.shape[1]
        return np.bincount(self.cells.ravel(), np.repeat(density * self.volumes / k, k), minlength=len(self.points)).astype(float)

    def _dilatation_rows(self) -> FloatArray:
        """Return the mean dilatation of every cell for each of its unknowns (m, k d), 1/mm."""
        rows = self.gradients.copy()
        rows[..., 0] += self.over_radius
        mean = np.einsum("mq,mqia->mia", self.weights, rows) / self.volumes[:, None, None]
        return np.asarray(mean.reshape(len(self.cells), -1))

    def _scattered(self, rows: FloatArray) -> sp.csr_matrix:
        m, k = self.cells.shape
        d = self.points.shape[1]
        index = (self.cells[:, :, None] * d + np.arange(d)).reshape(m, k * d)
        return sp.csr_matrix((rows.ravel(), (np.repeat(np.arange(m), k * d), index.ravel())), shape=(m, len(self.points) * d))
