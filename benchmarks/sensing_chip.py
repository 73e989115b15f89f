"""Convergence of the finite elements of the assumed sensing chip: ``python benchmarks/sensing_chip.py``.

Prints, for ever finer meshes of the whole chip, nodes, processor time, stiffness and the sensitivities to F_z and M_y; then the stress
concentration of fillets of 15 um.
"""

from __future__ import annotations

import time

from naibu.applications.sensing_chip.analysis import BEAMS_RESOLUTION
from naibu.applications.sensing_chip.bridge import sensitivity_matrix
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.fillets import filleted_end
from naibu.applications.sensing_chip.finite_elements import solve_chip

RESOLUTIONS = (ChipResolution(6, 1, 2, 2, 3), ChipResolution(8, 2, 2, 2, 3), ChipResolution(), ChipResolution(12, 2, 4, 3, 5))


def main() -> None:
    """Print one line a mesh."""
    print("nodes   processor s   stiffness N/mm   tilt mN m/rad   F_z mV/mN   M_y mV/(N um)")
    for resolution in RESOLUTIONS:
        began = time.process_time()
        response = solve_chip(assumed_chip(), resolution)
        matrix = sensitivity_matrix(response)
        seconds = time.process_time() - began
        print(
            f"{response.chip.mesh.n_points:6d} {seconds:11.1f} {1e-3 * response.force_stiffness:15.1f} "
            f"{1e-3 * response.moment_stiffness:15.2f} {matrix[0, 2]:12.4f} {matrix[2, 4]:13.3f}",
            flush=True,
        )
    print("\ncells of an eighth of a circle   processor s   concentration F_z   M_y   borne mN   N um   (fillets of 15 um)")
    beams = solve_chip(assumed_chip(), BEAMS_RESOLUTION, whole=False)
    for fineness in (2, 3, 4):
        began = time.process_time()
        end = filleted_end(assumed_chip(), 0.015, fineness=fineness)
        seconds = time.process_time() - began
        factors, limits = end.concentration(beams), end.load_limits(beams)
        print(f"{fineness:6d} {seconds:24.1f} {factors[0]:18.2f} {factors[1]:9.2f} {limits[0]:9.0f} {limits[1]:7.0f}", flush=True)


if __name__ == "__main__":
    main()
