"""Engines by the name of a device: Numba kernels on the processor, or NVIDIA Warp on a GPU."""

from __future__ import annotations

from naibu.core.errors import InputError
from naibu.mechanics.contact.session_protocol import Engine
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.gpu.engine import WarpLatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.state import STEP_S, ConstrainedNodes, LatticeState, Method

DEVICES = ("cpu", "cuda", "warp-cpu")


def lattice_engine(
    lattice: Lattice,
    parameters: LatticeParameters,
    *,
    step: float = STEP_S,
    method: Method = "implicit",
    tolerance: float = 1e-2,
    device: str = "cpu",
) -> Engine[LatticeState, ConstrainedNodes]:
    """Return the engine of a device.

    Parameters
    ----------
    lattice, parameters : Lattice, LatticeParameters
        What moves.
    step : float
        s.
    method, tolerance
        As of `LatticeEngine`.
    device : str
        ``"cpu"``: `LatticeEngine`; ``"cuda"``, or ``"cuda:1"`` and so on: `WarpLatticeEngine` on an NVIDIA GPU; ``"warp-cpu"``: the same
        kernels compiled for the processor, for tests.

    Raises
    ------
    InputError
        No such device, or what the engine refuses.
    MissingDependencyError
        Warp is not installed.
    """
    if device == "cpu":
        return LatticeEngine.of(lattice, parameters, step=step, method=method, tolerance=tolerance)
    if device == "warp-cpu":
        return WarpLatticeEngine.of(lattice, parameters, step=step, method=method, tolerance=tolerance, device="cpu")
    if device == "cuda" or device.startswith("cuda:"):
        return WarpLatticeEngine.of(lattice, parameters, step=step, method=method, tolerance=tolerance, device=device)
    raise InputError(f"device must be one of {', '.join(DEVICES)}, or a numbered GPU such as cuda:1, not {device!r}")
