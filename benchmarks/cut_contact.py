"""What the contact of the sides of a cut through a block hands over, with the normals of the blade and with those of the facets.

A cube of 20 mm is cut right through without friction by planes of some slope, and pressed between plates that hold its ends (free), that
hold its ends while the other faces cannot move across themselves (held), or by a patch of 10 mm on its top (patch). Printed are the force
in per cent of that of the same mesh before the cut, and the side force over the normal one, which between plates is the plane's slope.
Where the block is held, stress along the cut is as large as that across it, and with the normals of the blade, ties hold together the
steps in which facets follow the plane. Last is the least force that `softer_behind_cuts` lets a held block have in time steps while it
rises, where these ties take some steps to carry what they ought to; pages of cut bodies say that. A dash stands where no balance was found.

Usage: python benchmarks/cut_contact.py
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.mechanics import Assembler, PrescribedDisplacement, SolverSettings, elements, material
from naibu.mechanics.finite_strain.lip_assembly import with_lips
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing import boundary_faces, box, cut_volume, swept_blade
from naibu.simulation.cuts.cut_sides import outward_normals, softer_behind_cuts

SIZE = 20.0
PLANES = ((0.6, 0.0, 5), (0.47, 1.0, 5), (0.45, 4.0, 5), (0.3, 8.0, 6))  # height over the size, rise over it and 2 mm, cubes along an edge


def force(mesh: Mesh, assembler: Assembler, load: str) -> FloatArray:
    """Return the force on what presses, mN."""
    p = mesh.points
    top = p[:, 2] > SIZE - 1e-9
    if load == "patch":
        top &= np.hypot(*(p[:, :2] - 0.5 * SIZE).T) < 5.1
    fixed = np.repeat((top | (p[:, 2] < 1e-9))[:, None], 3, axis=1)
    if load == "held":
        fixed |= (p < 1e-9) | (p > SIZE - 1e-9)
    value = np.where(top[:, None], [0.0, 0.0, -0.2], 0.0)
    task = Problem(p, assembler, (), PrescribedDisplacement(fixed, value), np.zeros_like(p))
    try:
        found = solve(task, settings=SolverSettings(tolerance=1e-8))
    except ConvergenceError:
        return np.full(3, np.nan)
    return np.asarray(assembler.forces(found.displacement)[1][top].sum(axis=0))


def main() -> None:
    print("  nu     slope  load    force, % of the whole: blade   facets   side force over normal one: blade   facets   said of blade")
    for nu in (0.3, 0.45, 0.49, 0.499):
        law = material(young_modulus=10.0, poisson_ratio=nu)
        for height, rise, n in PLANES if nu < 0.499 else PLANES[:1]:
            edge = np.array([[-1.0, -1.0, height * SIZE], [-1.0, SIZE + 1.0, height * SIZE + rise]])
            blade = swept_blade(np.stack([edge, edge + np.array([SIZE + 2.0, 0.0, 0.0])]))
            cut = cut_volume(box((SIZE,) * 3, (n, n, n), cell_type="tetra", centred=False), blade, SIZE / n)
            places, number = np.unique(cut.mesh.points, axis=0, return_inverse=True)
            whole = Mesh.from_arrays(places, number.ravel()[cut.mesh.cells], "tetra")
            made = [Assembler.from_materials(elements(m, "mean_dilatation"), m.regions, [law]) for m in (whole, cut.mesh)]
            faces = boundary_faces(cut.mesh).faces
            sides = [
                with_lips(made[1], cut.mesh.points, faces, 0.0, cut.mesh.cells, outward) for outward in (outward_normals(cut, blade), None)
            ]
            for load in ("free", "held", "patch"):
                one = force(whole, made[0], load)[2]
                f = [force(cut.mesh, assembler, load) for assembler in sides]
                said = f"{100.0 - softer_behind_cuts(sides[0]):13.1f}" if load == "held" else ""
                line = (
                    f"  {nu:5.3f}  {rise / (SIZE + 2.0):5.3f}  {load:6s}  {100.0 * f[0][2] / one:28.1f}  {100.0 * f[1][2] / one:7.1f}   "
                    f"{-f[0][1] / f[0][2]:33.3f}  {-f[1][1] / f[1][2]:7.3f}   {said}"
                )
                print(line.replace("nan", "  -"), flush=True)


if __name__ == "__main__":
    main()
