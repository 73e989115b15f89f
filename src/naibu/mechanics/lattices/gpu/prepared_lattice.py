"""A lattice on a device of Warp, prepared for steps of one length by one method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.gpu.coarse_levels import CoarseLevels
from naibu.mechanics.lattices.gpu.device_arrays import (
    NeighbourLists,
    alike_elements,
    chosen_device,
    warp_package,
)
from naibu.mechanics.lattices.gpu.warp_types import WarpArray
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, require_positive
from naibu.mechanics.lattices.model.state import (
    STEP_S,
    Method,
)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedLattice:
    """A lattice on a device of Warp, prepared for steps of one length by one method.

    Attributes
    ----------
    lattice : Lattice
        Masses and elements.
    parameters : LatticeParameters
        Of the elements.
    step : float
        s.
    method : str
        As in `LatticeEngine`.
    tolerance : float
        Of the implicit solver, relative to the residual that the old velocity leaves.
    device : warp device
        Where it moves.
    lists : NeighbourLists
        Elements by mass.
    row, table, stiffness : warp array
        Numbers of the rows of coefficients of the elements, these rows, and K of each.
    mass, inverse_mass : warp array
        kg and 1/kg.
    diagonal : ndarray, shape (n,)
        Of the matrix of an implicit step, mean of the axes, kg; empty with the explicit methods.
    coarse : CoarseLevels, optional
        Coarse levels of the implicit solver's preconditioner, where they pay.
    """

    lattice: Lattice
    parameters: LatticeParameters
    step: float
    method: Method
    tolerance: float
    device: object
    lists: NeighbourLists
    row: WarpArray
    table: WarpArray
    stiffness: WarpArray
    mass: WarpArray
    inverse_mass: WarpArray
    diagonal: FloatArray
    coarse: CoarseLevels | None

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        parameters: LatticeParameters,
        *,
        step: float = STEP_S,
        method: Method = "implicit",
        precision: Literal["double", "single"] = "double",
        tolerance: float = 1e-2,
        device: str | None = None,
    ) -> Self:
        """Prepare a lattice.

        Parameters
        ----------
        lattice, parameters : Lattice, LatticeParameters
            What moves.
        step : float
            s.
        method, precision, tolerance
            As of `LatticeEngine`. The implicit solver works in double precision throughout.
        device : str
            ``"cuda:0"``, ``"cpu"``, ...; by default the current CUDA device, and the processor where there is none.

        Raises
        ------
        MissingDependencyError
            Warp is not installed.
        InputError
            A step or tolerance that is not positive, parameters of another lattice, an unknown method, precision or device, or single
            precision with the implicit method.
        """
        _check(lattice, parameters, step, method, precision, tolerance)
        place, wp = chosen_device(device), warp_package()
        real, row4 = (wp.float32, wp.vec4f) if precision == "single" else (wp.float64, wp.vec4d)
        lists = NeighbourLists.of(lattice, place)
        codes, rows = alike_elements(parameters)
        coefficients = implicit_coefficients(rows, step) if method == "implicit" else _explicit_rows(rows, step, method == "euler")
        mass = lattice.node_mass
        diagonal, coarse = np.zeros(0), None
        if method == "implicit":
            stiff = step**2 * coefficients[0][codes]
            i, j = lattice.elements.T
            diagonal = mass + sum(np.bincount(end, stiff / 3.0, minlength=lattice.n_nodes) for end in (i, j))
            coarse = CoarseLevels.of(lattice, stiff, diagonal, place)
        return cls(
            lattice,
            parameters,
            float(step),
            method,
            float(tolerance),
            place,
            lists,
            wp.array(lists.at_both_ends(codes, codes.dtype.type), device=place),
            wp.array(np.stack(coefficients, axis=1), dtype=row4, device=place),
            wp.array(rows.stiffness, dtype=real, device=place),
            wp.array(mass, dtype=real, device=place),
            wp.array(np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0), dtype=real, device=place),
            diagonal,
            coarse,
        )


def _explicit_rows(parameters: LatticeParameters, step: float, forward: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    a, b, d, g = explicit_coefficients(parameters)
    if not forward:  # the tension follows the extension after the step, as positions follow the velocity after it
        a, b = a + b * d * step, b * (1.0 - g * step)
    return a, b, d * step, g * step


def _check(lattice: Lattice, parameters: LatticeParameters, step: float, method: str, precision: str, tolerance: float) -> None:
    require_positive(step, "the step", "s")
    require_positive(tolerance, "the tolerance", "")
    if tolerance >= 1.0:
        raise InputError(f"the tolerance is a fraction of the residual and must be below 1, not {tolerance:g}")
    if len(parameters.stiffness) != lattice.n_elements:
        raise InputError(f"there are parameters for {len(parameters.stiffness)} elements, the lattice has {lattice.n_elements}")
    if method not in ("implicit", "euler", "symplectic_euler"):
        raise InputError(f"methods are 'implicit', 'euler' and 'symplectic_euler', not {method!r}")
    if precision not in ("double", "single"):
        raise InputError(f"precision is 'double' or 'single', not {precision!r}")
    if precision == "single" and method == "implicit":
        raise InputError("the implicit method needs precision='double' on a GPU; single precision is for the explicit methods")
