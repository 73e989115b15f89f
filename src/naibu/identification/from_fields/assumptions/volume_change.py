"""Whether components of measured displacements have the signs of the positions, judged by how much volume the field changes.

Where forces may act on the whole surface, any field that is smooth is one of some elastic body, and equilibrium does not tell signs. But
tissue and gels hardly change their volume. With the sign of one component changed, what one direction gives another no longer takes: the
volume then seems to change by as much as the shape. The gradient of the displacement is that of the nearest one that is interpolated in
cells, found without any mechanics, and the volume is that of finite strain.

It is no proof: lungs and foams change their volume as well. Two readings are left open besides. Reversed displacements change volume by
second orders of strain alone, as a Poisson's ratio somewhat below 0.5 does. And with components in another order a body that is squeezed, a
sponge between plates, is one that is sheared: fields of either may be right. Nor is noise a change of volume: where strains are small, as
in a plate that is bent or a body that was turned between the scans, its gradient changes the volume as much as the shape, and components in
another order make a large strain of the turn. What is doubted must therefore be found by two halves of the points alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.representation_error import nearest_interpolated
from naibu.mechanics.finite_elements.elements import elements

MUCH, LITTLE = 0.4, 0.3  # change of volume over that of shape, root mean square: of fields that are doubted, and of other readings
DECISIVE = 3.0  # times as much as with other signs: a sponge in shear had twice as much, and all other true fields less


@dataclass(frozen=True, slots=True, eq=False)
class VolumeChange:
    """How much volume a field changes, over how much shape, root mean square.

    Attributes
    ----------
    given : float
        With the components as they are, or all reversed, whichever is less.
    flipped, reordered : float
        The least with the sign of one component changed, and with components in another order.
    beyond_noise : float
        As `given`, without the noise: from products of what either half of the points says.
    component, order : int, ndarray
        That component, and the matrix (3, 3) that orders them, of a 1 or -1 in every row; times -1 it may be right as well.
    """

    given: float
    flipped: float
    reordered: float
    beyond_noise: float
    component: int
    order: FloatArray

    @property
    def wrong_sign(self) -> bool:
        """Whether the sign of one component is far likelier another one, in a body that hardly changes its volume."""
        return self.flipped <= self.reordered and self._far_likelier(self.flipped)

    @property
    def doubtful_order(self) -> bool:
        """Whether components in another order are those of a body that hardly changes its volume, which the given ones are not."""
        return not self.wrong_sign and self._far_likelier(self.reordered)

    @property
    def signs_told(self) -> bool:
        """Whether the signs of single components are told by the field: with another one it would change volume far more."""
        return self.flipped > DECISIVE * self.given

    def _far_likelier(self, other: float) -> bool:
        return min(self.given, self.beyond_noise) > MUCH and self.given > DECISIVE * other and other < LITTLE


def volume_change(mesh: Mesh, load_case: FieldLoadCase) -> VolumeChange:
    """Return how much volume a field changes with its components as they are, and otherwise.

    Parameters
    ----------
    mesh : Mesh
        The body in space, of cells as coarse as show its shape.
    load_case : FieldLoadCase
        What was measured.
    """
    gradient, weight = mean_gradients(mesh, nearest_interpolated(mesh, load_case.field))
    unit = np.eye(3)
    flips = [np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)]  # two signs are the negative of the third
    signs = [np.array([1.0, *rest]) for rest in product((1.0, -1.0), repeat=2)]
    orders = [s[:, None] * unit[list(axes)] for axes in permutations(range(3)) if axes != (0, 1, 2) for s in signs]
    shares = [_share(gradient, weight, matrix) for matrix in (unit, *flips, *orders)]
    flip, order = int(np.argmin(shares[1:4])), int(np.argmin(shares[4:]))
    beyond = _beyond_noise(mesh, load_case.field, weight)
    return VolumeChange(shares[0], shares[1 + flip], shares[4 + order], beyond, flip, orders[order])


def _beyond_noise(mesh: Mesh, field: DisplacementField, weight: FloatArray) -> float:
    """Return the change of volume over that of shape from products of what two halves of the points say: their noise is independent."""
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(field.valid))
    everything = np.arange(len(field.valid))
    halves = (replace(field, valid=np.isin(everything, half)) for half in (drawn[::2], drawn[1::2]))
    one, other = (mean_gradients(mesh, nearest_interpolated(mesh, half))[0] for half in halves)
    shape = float(np.average((_deviator(one) * _deviator(other)).sum(axis=(1, 2)), weights=weight))
    change = min(float(np.average(_dilatation(sign * one) * _dilatation(sign * other), weights=weight)) for sign in (1.0, -1.0))
    return float(np.sqrt(max(change, 0.0) / shape)) if shape > 0.0 else 0.0


def mean_gradients(mesh: Mesh, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean gradient of a displacement (n, 3), mm, in every cell (m, 3, 3), and the volumes of the cells (m,), mm^3."""
    discrete = elements(mesh, "standard")
    volume = discrete.weights.sum(axis=1)
    return np.einsum("mq,mai,mqaj->mij", discrete.weights, u[mesh.cells], discrete.gradients) / volume[:, None, None], volume


def _share(gradient: FloatArray, weight: FloatArray, matrix: FloatArray) -> float:
    """Return the change of volume over that of shape with vectors multiplied by a matrix, or by its negative, whichever is less."""
    turned = np.einsum("ij,mjk->mik", matrix, gradient)
    shape = float(np.average((_deviator(turned) ** 2).sum(axis=(1, 2)), weights=weight))
    change = min(float(np.average(_dilatation(sign * turned) ** 2, weights=weight)) for sign in (1.0, -1.0))
    return float(np.sqrt(change / max(shape, 1e-300)))


def _deviator(gradient: FloatArray) -> FloatArray:
    strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    return np.asarray(strain - np.einsum("mkk->m", strain)[:, None, None] / 3.0 * np.eye(3))


def _dilatation(gradient: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.det(np.eye(3) + gradient) - 1.0)
