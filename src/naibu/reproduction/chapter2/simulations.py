"""Simulations of the 2008 report :cite:p:`hirai2008` (chapter 2): three squares loaded and released, and the blocks of agar.

Values printed in the report are the defaults of the parameters. What it does not state - the size of the squares, depth and width of the
indentation, the loading time of the agar - is a parameter too; `ASSUMED` lists the values chosen. The numbers of the squares are printed
without units: they are taken as mm, kPa, kPa s and kg/mm^3, and any other consistent system gives the same motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.dynamics import Series, simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import Rheology, elastic, maxwell, three_element
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.primitives import box
from naibu.meshing.structured_2d import rectangle

SQUARES: Mapping[str, Rheology] = MappingProxyType(
    {
        "elastic square": elastic(10.0, 0.35),
        "viscoplastic square": maxwell(90.0, 50.0, 0.35),
        "rheological square": three_element(30.0, 200.0, 500.0, 0.35),
    }
)
PHASES_S = (10.0, 20.0, 30.0)  # end of loading, of holding, of recovery
AGAR = three_element(10.0, 100.0, 300.0, 0.35)  # 0.01e6 N/m^2, 0.1e6 and 0.3e6 N s/m^2
AGAR_SIZE_MM = (75.0, 75.0, 30.0)  # x, z, height
AGAR_MASS_KG = 0.2
AGAR_PUSH_MM = 7.5
WEIGHT_MM = 40.0
MR_SIZE_MM = (55.0, 25.0)  # x, height
NAMES = (*SQUARES, "agar block", "agar block, 3-D", "agar under a bar")
ASSUMED = MappingProxyType(
    {
        "side of the squares": "1, with 10 x 10 cells and alternating diagonals: no size is printed",
        "indentation of the squares": "0.2 of the side, on the middle fifth of the top, without slip: neither is printed",
        "agar, loading": "1 s, then constant; no effect on the shape in equilibrium",
        "agar, weight and floor": "no slip, as for the squares ('fixed on the floor'); variants are shown",
        "agar under a bar": "plane strain; strip of 15 mm; base at y = 4 mm, middle at x = 25 mm of the table's axes",
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The result of a simulation.

    Attributes
    ----------
    name : str
        One of `NAMES`.
    mesh : Mesh
        Mesh of the body, mm.
    material : Rheology
        Viscoelastic material, kPa and kPa s.
    series : Series
        Displacements, reactions and energies over time.
    middle_top : int
        Node in the middle of the loaded face.
    """

    name: str
    mesh: Mesh
    material: Rheology
    series: Series
    middle_top: int

    def displacement_at(self, points: ArrayLike, time_s: float) -> FloatArray:
        """Return the displacement (k, d), mm, at points (k, d) of the reference configuration, mm, at the stored time nearest to `time_s`.

        Raises
        ------
        InputError
            A point lies outside the body.
        """
        wanted, mesh = np.asarray(points, dtype=float), self.mesh
        corners = mesh.points[mesh.cells]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
        out = np.empty_like(wanted)
        u = self.series.displacement[int(np.argmin(np.abs(self.series.times - time_s)))]
        for i, point in enumerate(wanted):
            inner = np.einsum("md,mdk->mk", point - corners[:, 0], inverse)
            weights = np.hstack([1.0 - inner.sum(axis=1, keepdims=True), inner])
            cell = int(np.argmax(weights.min(axis=1)))
            if weights[cell].min() < -1e-9:
                raise InputError(f"point {point.tolist()} lies outside the body of the study {self.name!r}")
            out[i] = weights[cell] @ u[mesh.cells[cell]]
        return out


def pushed_square(
    name: str,
    *,
    side_mm: float = 1.0,
    divisions: int = 10,
    push_mm: float = 0.2,
    pushed_fraction: float = 0.2,
    density: float | None = 6.4,
    step_s: float = 0.05,
    method: str = "sdirk2",
) -> Study:
    """Indent the middle of a square's top for 10 s, keep it for 10 s, and release it for 10 s (figures 1 to 3 of the paper).

    Parameters
    ----------
    name : str
        ``"elastic square"``, ``"viscoplastic square"`` or ``"rheological square"``.
    side_mm, divisions : float and int
        Edge length, and cells per edge.
    push_mm, pushed_fraction : float
        Indentation depth, and loaded fraction of the top.
    density : float or None
        Density, kg/mm^3; None neglects inertia.
    step_s : float
        Time step, and time between stored states, s.
    method : str
        Time integration, see `simulate_motion`.

    Raises
    ------
    InputError
        There is no square of this name.
    """
    if name not in SQUARES:
        raise InputError(f"there is no square called {name!r}; available are {', '.join(SQUARES)}")
    mesh = rectangle((side_mm, side_mm), (divisions, divisions))
    x, y = mesh.points.T
    top = np.flatnonzero((y > side_mm * (1.0 - 1e-9)) & (np.abs(x) <= side_mm * (0.5 * pushed_fraction + 1e-9)))
    path = PrescribedMotion.through([0.0, PHASES_S[0]], [(0.0, 0.0), (0.0, -push_mm)])
    supports = [Support("floor", np.flatnonzero(y == 0.0)), Support("indenter", top, motion=path, end_s=PHASES_S[1])]
    times = np.linspace(0.0, PHASES_S[2], round(PHASES_S[2] / step_s) + 1)
    series = simulate_motion(LinearBody.of(mesh), SQUARES[name], density, supports, times, method=method)
    return Study(name, mesh, SQUARES[name], series, _nearest(mesh, (0.0, side_mm)))


def agar_block(
    *,
    shifted_cells: float = 0.0,
    material: Rheology = AGAR,
    weight_sticks: bool = True,
    floor_sticks: bool = True,
    push_s: float = 1.0,
    duration_s: float = 6.0,
    step_s: float = 0.1,
) -> Study:
    """Indent the agar block by 7.5 mm under the weight of 40 mm width, in plane strain, on the report's mesh of 30 x 12 cells of 2.5 mm.

    Parameters
    ----------
    shifted_cells : float
        Shift of the weight to the left, in cells.
    material : Rheology
        Material; as printed by default.
    weight_sticks, floor_sticks : bool
        Whether there is no slip under the weight, and on the floor; otherwise they are frictionless.
    push_s, duration_s, step_s : float
        Duration of the loading, of the whole simulation, and of a time step, s.
    """
    width, depth, height = AGAR_SIZE_MM
    mesh = rectangle((width, height), (30, 12))
    x, y = mesh.points.T
    middle = -shifted_cells * width / 30
    top = np.flatnonzero((y == height) & (np.abs(x - middle) <= 0.5 * WEIGHT_MM + 1e-9))
    path = PrescribedMotion.through([0.0, push_s], [(0.0, 0.0), (0.0, -AGAR_PUSH_MM)])
    supports = [
        Support("floor", np.flatnonzero(y == 0.0), axes=None if floor_sticks else (1,)),
        Support("weight", top, axes=None if weight_sticks else (1,), motion=path),
    ]
    if not (weight_sticks or floor_sticks):
        supports.append(Support("middle", np.array([_nearest(mesh, (0.0, 0.0))]), axes=(0,)))
    density = AGAR_MASS_KG / (width * depth * height)
    body = LinearBody.of(mesh, thickness_mm=depth)
    times = np.linspace(0.0, duration_s, round(duration_s / step_s) + 1)
    series = simulate_motion(body, material, density, supports, times)
    return Study("agar block", mesh, material, series, _nearest(mesh, (middle, height)))


def agar_block_3d(
    *, shift_mm: float = 0.0, material: Rheology = AGAR, cell_mm: float = 3.75, push_s: float = 1.0, duration_s: float = 6.0
) -> Study:
    """Indent the three-dimensional block, 75 x 75 x 30 mm, under a round weight; the report computed plane strain.

    Parameters
    ----------
    shift_mm : float
        How far the weight lies left of the middle.
    material : Rheology
        Material; as printed by default.
    cell_mm : float
        Size of the cells that are cut into six tetrahedra each.
    push_s, duration_s : float
        Duration of the push and of the whole. Inertia is left out.
    """
    width, depth, height = AGAR_SIZE_MM
    mesh = box((width, depth, height), [max(2, round(size / cell_mm)) for size in AGAR_SIZE_MM], cell_type="tetra")
    x, y, z = mesh.points.T
    top = np.flatnonzero((z > height - 1e-9) & (np.hypot(x + shift_mm, y) <= 0.5 * WEIGHT_MM + 1e-9))
    path = PrescribedMotion.through([0.0, push_s], [(0.0, 0.0, 0.0), (0.0, 0.0, -AGAR_PUSH_MM)])
    supports = [Support("floor", np.flatnonzero(z < 1e-9)), Support("weight", top, motion=path)]
    series = simulate_motion(LinearBody.of(mesh), material, None, supports, [0.0, push_s, duration_s], step=0.5)
    return Study("agar block, 3-D", mesh, material, series, _nearest(mesh, (-shift_mm, 0.0, height)))


def agar_under_bar(
    *,
    push_mm: float = 1.0,
    strip_mm: float = 15.0,
    material: Rheology = AGAR,
    cell_mm: float = 2.5,
    path_s: tuple[float, float, float] | None = None,
) -> Study:
    """Indent the cross-section of the MR block under the bar, in plane strain; displacements are proportional to `push_mm`.

    Parameters
    ----------
    push_mm : float
        Indentation depth; the report does not state it.
    strip_mm : float
        Width of the contact with the round bar, mm.
    material : Rheology
        Material; as printed for the block of section 2.4, which is the same agar.
    cell_mm : float
        Edge length of the cells, mm.
    path_s : tuple of float
        When the bar has gone down, begins to rise and is at its first height again, s; by default it goes down within 1 s and stays.
    """
    width, height = MR_SIZE_MM
    mesh = rectangle((width, height), (round(width / cell_mm), round(height / cell_mm)))
    x, y = mesh.points.T
    top = np.flatnonzero((y == height) & (np.abs(x) <= 0.5 * strip_mm + 1e-9))
    depths, ends = ([0.0, push_mm], [0.0, 1.0]) if path_s is None else ([0.0, push_mm, push_mm, 0.0], [0.0, *path_s])
    path = PrescribedMotion.through(ends, [(0.0, -depth) for depth in depths])
    supports = [Support("floor", np.flatnonzero(y == 0.0)), Support("bar", top, motion=path)]
    times = ends if path_s is None else np.arange(0.0, path_s[-1] + 1.0, 0.1)
    series = simulate_motion(LinearBody.of(mesh), material, None, supports, times, step=0.5 if path_s is None else 0.1)
    return Study("agar under a bar", mesh, material, series, _nearest(mesh, (0.0, height)))


def run(name: str) -> Study:
    """Run a study with its default parameters.

    Raises
    ------
    InputError
        There is no study of this name.
    """
    if name in SQUARES:
        return pushed_square(name)
    others: Mapping[str, Callable[[], Study]] = {
        "agar block": agar_block,
        "agar block, 3-D": agar_block_3d,
        "agar under a bar": agar_under_bar,
    }
    if name not in others:
        raise InputError(f"there is no study called {name!r}; available are {', '.join(NAMES)}")
    return others[name]()


def _nearest(mesh: Mesh, point: ArrayLike) -> int:
    return int(np.argmin(np.linalg.norm(mesh.points - np.asarray(point, dtype=float), axis=1)))
