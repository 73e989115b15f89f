"""Virtual bodies of the 2008 report :cite:p:`hirai2008` (chapter 3.4): a square of triangles and a cube of tetrahedra, loaded on top.

The report shows its meshes only in a figure (3.9), and does not print the moduli of the known half. The symmetric cube is assumed to
consist of cells of six tetrahedra, each cell the mirror image of its neighbours, which spreads the moduli nearly as printed; in the
asymmetric one all cells are equal. The known half has the moduli of the uniform case (500 Pa, 0.43).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters, material
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.small_strain.linear_elasticity import LinearBody

Split = Literal["symmetric", "asymmetric"]
UNIFORM = (0.5, 0.43)  # Young's modulus, kPa, and Poisson's ratio
LAYERS = {"layer 1": (0.25, 0.43), "layer 2": (0.5, 0.38)}
SQUARE = (5.0, 0.43)
# displacements of the top of the square (2007 paper, Table 2), mm; x to the left and y downwards are positive there
SQUARE_PUSHES = (((0.0, 25.0), (25.0, 25.0)), ((0.0, 30.0), (30.0, 30.0)), ((0.0, 50.0), (50.0, 50.0)), ((0.0, 50.0), (100.0, 100.0)))
# hexahedra in VTK order: coordinates of the corners
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


@dataclass(frozen=True, slots=True, eq=False)
class PushedBody:
    """A virtual body on a fixed floor whose top face is displaced, with its true moduli.

    Attributes
    ----------
    name : str
        Name in tables.
    mesh : Mesh
        Mesh, mm; the last axis is vertical, the floor is at zero.
    truth : mapping of str to (float, float)
        Young's modulus, kPa, and Poisson's ratio of every region.
    known : tuple of str
        Regions whose moduli are known.
    pushes : tuple of ndarray, shape (d,) or (top nodes, d)
        Displacement of the top face in every load case, mm.
    law : str
        Constitutive law, see `naibu.mechanics.finite_elements.modulus_derivatives`.
    """

    name: str
    mesh: Mesh
    truth: Mapping[str, tuple[float, float]]
    known: tuple[str, ...]
    pushes: tuple[FloatArray, ...]
    law: SimplexLaw = "linear"

    @property
    def moduli(self) -> tuple[FloatArray, FloatArray]:
        """True Lamé parameters lambda and mu of every cell, (m,) each, kPa."""
        table = np.array([lame_parameters(*self.truth[name]) for name in self.mesh.region_names])[self.mesh.regions]
        return table[:, 0], table[:, 1]

    @property
    def constrained(self) -> BoolArray:
        """Constrained nodes of floor and top, boolean (n,), on which unknown forces act."""
        height = self.mesh.points[:, -1]
        return np.asarray((height < 1e-9) | (height > height.max() - 1e-9))

    def zones(self, *, each_cell: bool | Sequence[str] = False) -> Zones:
        """Return the unknown regions, or their cells, as zones."""
        return Zones.of(self.mesh, known={name: self.truth[name] for name in self.known}, each_cell=each_cell)

    def displacement(self, push: ArrayLike, moduli: tuple[FloatArray, FloatArray] | None = None) -> FloatArray:
        """Return the equilibrium displacement (n, d), mm, with the true moduli or with others, (m,) each, kPa.

        Raises
        ------
        InputError
            A finite-strain law in two dimensions.
        """
        lame, shear = self.moduli if moduli is None else moduli
        height = self.mesh.points[:, -1]
        floor, top = np.flatnonzero(height < 1e-9), np.flatnonzero(height > height.max() - 1e-9)
        prescribed = PrescribedDisplacement.none(self.mesh.n_points, self.mesh.dimension).and_also(floor, np.zeros(self.mesh.dimension))
        prescribed = prescribed.and_also(top, np.asarray(push, dtype=float))
        if self.law == "linear":
            return LinearBody.of(self.mesh).solve(lame, shear, prescribed)
        if self.mesh.dimension != 3:
            raise InputError(f"the law {self.law!r} is solved on tetrahedra only, not on {self.mesh.cell_type!r} cells")
        some = material(self.law, young_modulus=1.0, poisson_ratio=0.3)
        assembler = Assembler.from_materials(elements(self.mesh, "standard"), np.zeros_like(self.mesh.regions), [some])
        parameters = np.zeros((self.mesh.n_cells, 4))
        parameters[:, 0], parameters[:, 1] = shear, lame
        problem = Problem(self.mesh.points, assembler.with_parameters(parameters), (), prescribed, np.zeros_like(self.mesh.points))
        return solve(problem, settings=SolverSettings(tolerance=1e-11)).displacement

    def load_cases(self, *, sd_mm: float = 0.0, seed: int = 0) -> tuple[FieldLoadCase, ...]:
        """Return the load cases as measured at the nodes of the same mesh, with normal noise of SD `sd_mm`, mm, at every node."""
        rng = np.random.default_rng(seed)
        out = []
        for k, push in enumerate(self.pushes):
            u = self.displacement(push)
            field = DisplacementField.from_arrays(self.mesh.points, u + sd_mm * rng.standard_normal(u.shape), sd_mm=sd_mm)
            out.append(FieldLoadCase.of(f"push {k + 1}", field, self.mesh, loaded=self.constrained))
        return tuple(out)


def square(pushes: Sequence[ArrayLike] = SQUARE_PUSHES[0], *, divisions: int = 4) -> PushedBody:
    """Return the uniform square of 200 x 200 mm of Figs. 3.6 and 8 (2007), its upper half known.

    The diagonal of every cell falls to the right. Cell 2 (i + 4 j) + k is the triangle of that number in the figure, with k = 0 below the
    diagonal and 1 above; node i + 5 j likewise. `pushes` are given as in the 2007 paper, x to the left and y downwards.
    """
    n = divisions
    points = _grid(np.linspace(0.0, 200.0, n + 1), np.linspace(0.0, 200.0, n + 1))
    j, i = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corner = i + (n + 1) * j
    lower, upper = np.stack([corner, corner + 1, corner + n + 1], axis=1), np.stack([corner + 1, corner + n + 2, corner + n + 1], axis=1)
    cells = np.stack([lower, upper], axis=1).reshape(-1, 3)
    mesh = Mesh.from_arrays(points, cells, "triangle", regions=np.repeat(2 * j >= n, 2), region_names=("lower half", "upper half"))
    given = tuple(-np.asarray(push, dtype=float) for push in pushes)
    return PushedBody("square", mesh, {"lower half": SQUARE, "upper half": SQUARE}, ("upper half",), given)


def cube(
    layers: Mapping[str, tuple[float, float]] | None = None,
    *,
    split: Split = "symmetric",
    divisions: int = 4,
    pushes: Sequence[ArrayLike] = ((0.0, 0.0, -10.0),),
    known: tuple[float, float] = UNIFORM,
    law: SimplexLaw = "linear",
) -> PushedBody:
    """Return the cube of 40 mm of Figs. 3.10 and 3.14: the upper half known, the lower one of equal layers, one by default.

    Parameters
    ----------
    layers : mapping of str to (float, float), optional
        Unknown layers from the floor up, with Young's modulus, kPa, and Poisson's ratio; ``{"lower half": UNIFORM}`` by default.
    split : {"symmetric", "asymmetric"}
        Figure 3.9 (a) or (b); see `split_hexahedra`.
    divisions : int
        Cells per edge; even, and for two layers a multiple of four.
    pushes : sequence of array_like, shape (3,) or (top nodes, 3)
        Displacement of the top face, mm; ten millimetres down by default.
    known : (float, float)
        Young's modulus, kPa, and Poisson's ratio of the upper half.
    law : str
        Constitutive law, see `naibu.mechanics.finite_elements.modulus_derivatives`.

    Raises
    ------
    InputError
        `divisions` does not fit the boundaries of the layers.
    """
    unknown = dict(layers) if layers is not None else {"lower half": UNIFORM}
    if divisions % (2 * len(unknown)):
        raise InputError(f"divisions = {divisions} does not fit {len(unknown)} layers; use a multiple of {2 * len(unknown)}")
    axis = np.linspace(0.0, 40.0, divisions + 1)
    index = np.array(list(np.ndindex(divisions, divisions, divisions)))[:, ::-1]
    numbers = index[:, None, :] + _CORNERS
    hexahedra = numbers @ np.array([1, divisions + 1, (divisions + 1) ** 2])
    layer = np.minimum(index[:, 2] * 2 * len(unknown) // divisions, len(unknown))
    cells, regions = split_hexahedra(hexahedra, index, split), np.repeat(layer, 6)
    names = (*unknown, "upper half")
    mesh = Mesh.from_arrays(_grid(axis, axis, axis), cells, "tetra", regions=regions, region_names=names)
    given = tuple(np.asarray(push, dtype=float) for push in pushes)
    return PushedBody(f"cube, {split}", mesh, unknown | {"upper half": known}, ("upper half",), given, law)


def split_hexahedra(hexahedra: IntArray, index: IntArray, split: Split = "symmetric") -> IntArray:
    """Split the hexahedra of a grid into six tetrahedra each.

    Parameters
    ----------
    hexahedra : ndarray, shape (m, 8), int64
        Nodes in VTK order.
    index : ndarray, shape (m, 3), int64
        Grid indices of every cell.
    split : {"symmetric", "asymmetric"}
        ``"asymmetric"`` is Kuhn's subdivision, equal in all cells; in ``"symmetric"`` cells are mirror images of their neighbours, so that
        the mesh is symmetric about the middle planes of a grid with an even number of cells.

    Returns
    -------
    ndarray, shape (6 m, 4), int64
        Positively oriented where the hexahedra are.

    Raises
    ------
    InputError
        Another split.
    """
    if split not in ("symmetric", "asymmetric"):
        raise InputError(f"split {split!r} is not known; use 'symmetric' or 'asymmetric'")
    paths = np.array(
        [np.vstack([np.zeros((1, 3), dtype=int), np.cumsum(np.eye(3, dtype=int)[list(p)], axis=0)]) for p in permutations(range(3))]
    )
    mirrored = (index % 2 == 1) & (split == "symmetric")
    corners = np.where(mirrored[:, None, None, :], 1 - paths, paths)
    corner_number = np.zeros((2, 2, 2), dtype=int)
    corner_number[tuple(_CORNERS.T)] = np.arange(8)
    local = corner_number[tuple(np.moveaxis(corners, -1, 0))]
    cells = np.take_along_axis(hexahedra[:, None, :], local, axis=2)
    edges = np.diff(corners, axis=2)
    wrong = np.linalg.det(edges) < 0.0
    cells[wrong] = cells[wrong][:, [0, 2, 1, 3]]
    return np.asarray(cells.reshape(-1, 4), dtype=np.int64)


def shape_error_percent(first: FloatArray, second: FloatArray, width_mm: float, height_mm: float) -> float:
    """Return the report's error (3.35), per cent: sum of squared distances of the nodes (n, d), mm, over width times height."""
    return 100.0 * float(((first - second) ** 2).sum()) / (width_mm * height_mm)


def _grid(*axes: ArrayLike) -> FloatArray:
    """Return the points (n, d) of a tensor grid, the first coordinate fastest."""
    parts = np.meshgrid(*[np.asarray(a, dtype=float) for a in reversed(axes)], indexing="ij")
    return np.stack([part.ravel() for part in reversed(parts)], axis=1)
