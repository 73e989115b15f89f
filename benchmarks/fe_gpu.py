"""Is it worth solving a linear finite-element problem on a GPU? Conjugate gradients there, beside `LinearBody.solve` on the processor.

The cube of ``fe_linear.py`` (384 000 linear tetrahedra at 40 cells an edge). The processor assembles; the GPU is given the matrix and
solves by conjugate gradients in double precision, with the diagonal (Jacobi) or its 3 x 3 blocks (block Jacobi) as preconditioner: by
NVIDIA Warp on blocks of 3 x 3, by CuPy on single numbers. All times are of the clock, the least of the repeats, compilation not counted;
"to the device" includes the conversion of the matrix. The difference is the largest one from naibu's displacement, in parts of the
prescribed one.

Run: ``python benchmarks/fe_gpu.py [--cells 20,40] [--device cuda:0] [--with warp,cupy] [--repeats 3] [--record]``; Warp's device may
be ``cpu``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp
from fe_case import LOWERED, Array, Case, make_case, prescribed
from records import ResultTable, write_record

from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.small_strain.linear_elasticity import LinearBody

TOLERANCE = 1e-8  # of the residual, in parts of the right side
LIMIT = 20_000
COLUMNS = ("tetrahedra", "unknowns", "solver", "iterations", "assembled, s", "to the device, s", "solved, s", "in all, s", "difference")
Solve = Callable[[], tuple[Array, int]]


def clocked(action: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the least seconds that an action takes, and its result; it is done once before."""
    result, least = action(), np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = action()
        least = min(least, time.perf_counter() - start)
    return least, result


def system(case: Case) -> tuple[sp.bsr_matrix, Array]:
    """Return matrix and right side of the displacement beyond the prescribed one."""
    support = prescribed(case, LOWERED)
    matrix = LinearBody.of(case.mesh).stiffness(case.lame, case.shear)
    rhs = np.where(support.constrained.ravel(), 0.0, -(matrix @ support.values.ravel()))
    return with_dirichlet_rows(matrix, support.constrained), rhs


class OnWarp:
    """Conjugate gradients of NVIDIA Warp."""

    def __init__(self, device: str) -> None:
        self.wp: ModuleType = import_module("warp")
        self.sparse, self.linear = import_module("warp.sparse"), import_module("warp.optim.linear")
        self.wp.config.log_level = self.wp.LOG_WARNING
        self.device = self.wp.get_device(device)
        self.name = f"Warp {self.wp.__version__}, {self.device.name}"

    def send(self, matrix: sp.bsr_matrix, rhs: Array) -> tuple[Any, Any]:
        n = len(rhs) // 3
        rows = np.repeat(np.arange(n, dtype=np.int32), np.diff(matrix.indptr))
        arrays = [self.wp.array(values, dtype=self.wp.int32, device=self.device) for values in (rows, matrix.indices.astype(np.int32))]
        blocks = self.wp.array(matrix.data, dtype=self.wp.mat33d, device=self.device)
        built = self.sparse.bsr_from_triplets(n, n, *arrays, blocks)
        right = self.wp.array(rhs.reshape(-1, 3), dtype=self.wp.vec3d, device=self.device)
        self.wp.synchronize_device(self.device)
        return built, right

    def solver(self, sent: tuple[Any, Any], blocks: bool) -> Solve:
        matrix, right = sent
        kind = "block_jacobi_direct" if blocks else "diag"

        def solve() -> tuple[Array, int]:
            found = self.wp.zeros_like(right)
            inner = self.linear.preconditioner(matrix, kind)
            count, _, _ = self.linear.cg(matrix, right, found, tol=TOLERANCE, maxiter=LIMIT, M=inner, check_every=25)
            return found.numpy().reshape(-1), int(count)

        return solve


class OnCuPy:
    """Conjugate gradients of CuPy, on the current device."""

    def __init__(self, device: str) -> None:
        del device
        self.cp: ModuleType = import_module("cupy")
        self.sparse, self.linalg = import_module("cupyx.scipy.sparse"), import_module("cupyx.scipy.sparse.linalg")
        name = self.cp.cuda.runtime.getDeviceProperties(0)["name"].decode()
        self.name = f"CuPy {self.cp.__version__}, {name}"

    def send(self, matrix: sp.bsr_matrix, rhs: Array) -> tuple[Any, Any]:
        sent = self.sparse.csr_matrix(matrix.tocsr()), self.cp.asarray(rhs)
        self.cp.cuda.Device().synchronize()
        return sent

    def solver(self, sent: tuple[Any, Any], blocks: bool) -> Solve:
        matrix, right = sent
        cp, n = self.cp, len(right)

        def inverse() -> Any:
            if not blocks:
                return self.sparse.diags(1.0 / matrix.diagonal(), format="csr")
            entry = matrix.tocoo()
            own = entry.row // 3 == entry.col // 3
            found = cp.zeros((n // 3, 3, 3))
            found[entry.row[own] // 3, entry.row[own] % 3, entry.col[own] % 3] = entry.data[own]
            first = 3 * cp.arange(n // 3, dtype=cp.int32)[:, None, None]
            axes = cp.arange(3, dtype=cp.int32)
            rows, columns = (cp.broadcast_to(first + a, found.shape).ravel() for a in (axes[:, None], axes[None, :]))
            return self.sparse.csr_matrix((cp.linalg.inv(found).ravel(), (rows, columns)), shape=(n, n))

        def solve() -> tuple[Array, int]:
            count = 0

            def step(_: Any) -> None:
                nonlocal count
                count += 1

            found, failed = self.linalg.cg(matrix, right, rtol=TOLERANCE, maxiter=LIMIT, M=inverse(), callback=step)
            if failed:
                raise RuntimeError(f"conjugate gradients stopped after {count} iterations")
            return np.asarray(found.get()), count

        return solve


PACKAGES = {"warp": OnWarp, "cupy": OnCuPy}


def measured(cells: int, packages: list[Any], repeats: int) -> list[tuple[str | float | int, ...]]:
    case = make_case(cells)
    support = prescribed(case, LOWERED)
    size = (len(case.mesh.cells), 3 * case.mesh.n_points)
    whole, expected = clocked(lambda: LinearBody.of(case.mesh).solve(case.lame, case.shear, support), repeats)
    assembled, (matrix, rhs) = clocked(lambda: system(case), repeats)
    rows: list[tuple[str | float | int, ...]] = [(*size, "LinearBody.solve, processor", "", assembled, "", whole - assembled, whole, 0.0)]
    for package in packages:
        sending, sent = clocked(partial(package.send, matrix, rhs), repeats)
        for blocks in (False, True):
            taken, (change, count) = clocked(package.solver(sent, blocks), repeats)
            apart = float(np.abs(support.values + change.reshape(-1, 3) - expected).max() / LOWERED)
            kind = "block Jacobi" if blocks else "Jacobi"
            rows.append((*size, f"{package.name}, {kind}", count, assembled, sending, taken, assembled + sending + taken, apart))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cells", default="20,40", help="cells an edge; six tetrahedra each")
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--with", dest="packages", default="warp", help="warp, cupy or both")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--record", action="store_true")
    asked = parser.parse_args()
    on_gpu = asked.device.startswith("cuda")
    if on_gpu and not import_module("warp").is_cuda_available():
        parser.error("there is no CUDA device; --device cpu tries the program without one")
    if asked.record and not on_gpu:
        parser.error("--record keeps times of a GPU: use --device cuda:0")
    packages = [PACKAGES[name](asked.device) for name in asked.packages.split(",")]
    rows: list[tuple[str | float | int, ...]] = []
    for cells in (int(text) for text in asked.cells.split(",")):
        for row in measured(cells, packages, asked.repeats):
            print("  ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row), flush=True)
            rows.append(row)
        if asked.record:
            write_record("fe_gpu", [ResultTable("linear", COLUMNS, tuple(rows))])


if __name__ == "__main__":
    main()
