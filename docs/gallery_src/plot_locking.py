"""
A material of your own, and volumetric locking
==============================================

Gels and tissues are nearly incompressible: Poisson's ratio is close to 0.5. Standard elements then become far too stiff (volumetric
locking). Elements that average the dilatation (the default, ``"mean_dilatation"``) do not; this script shows the difference.
"""

# %%
# A material of your own
# ----------------------
# Give Young's modulus (kPa) and Poisson's ratio at small strain. :doc:`/concepts` lists the laws; for laws with more parameters,
# ``shape`` sets those that the two moduli leave open.
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import Assembler, PrescribedDisplacement, Problem, block_pattern, elements, law_named, material, solve
from naibu.meshing import box, side_nodes

Formulation = Literal["mean_dilatation", "standard"]
for name in ("neo_hookean", "mooney_rivlin", "yeoh"):
    law = law_named(name)
    print(f"{law.name}: {', '.join(law.parameter_names)} (kPa)")
print(material("yeoh", young_modulus=60.0, poisson_ratio=0.49, shape=(0.1, 0.0)))

SIDE_MM, COMPRESSION = 40.0, 0.15


# %%
# A block between bonded plates
# -----------------------------
# Bottom and top are constrained; the top moves down by 15 %. The function returns the force on the top.
def force(cells: int, poisson_ratio: float, formulation: Formulation) -> float:
    """Return the force, N, that compresses a block with `cells` hexahedra per edge."""
    mesh = box((SIDE_MM, SIDE_MM, SIDE_MM), (cells, cells, cells))
    body = elements(mesh, formulation)
    gel = material("neo_hookean", young_modulus=60.0, poisson_ratio=poisson_ratio)
    assembler = Assembler.from_materials(body, mesh.regions, [gel], block_pattern(mesh.n_points, body.connectivity))
    top = side_nodes(mesh, "z+")
    constrained = PrescribedDisplacement.none(mesh.n_points).and_also(side_nodes(mesh, "z-"), (0, 0, 0))
    constrained = constrained.and_also(top, (0.0, 0.0, -COMPRESSION * SIDE_MM))
    solution = solve(Problem(mesh.points, assembler, (), constrained, np.zeros_like(mesh.points)))
    internal = assembler.forces(solution.displacement)[1]
    return -float(internal[top, 2].sum()) / 1000.0


# %%
# The incompressible limit
# ------------------------
# Standard elements lock, and refining the mesh helps only slowly. Elements with mean dilatation are accurate even on a coarse mesh.
ratios = np.array([0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499])
cells = (4, 8)
kinds: tuple[Formulation, ...] = ("mean_dilatation", "standard")
forces = {(n, kind): [force(n, nu, kind) for nu in ratios] for n in cells for kind in kinds}
reference = np.array(forces[8, "mean_dilatation"])
for (n, kind), values in forces.items():
    excess = 100 * (np.array(values) / reference - 1.0)
    print(f"{kind:16} {n}^3 elements: " + "  ".join(f"{e:+6.1f} %" for e in excess))

figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4), layout="constrained")
styles = {"mean_dilatation": ("tab:blue", "mean dilatation"), "standard": ("tab:red", "standard")}
for (n, kind), values in forces.items():
    colour, label = styles[kind]
    line = "-" if n == max(cells) else "--"
    style = {"marker": "o", "linestyle": line, "color": colour, "markersize": 4}
    left.semilogx(1.0 - 2.0 * ratios, values, label=f"{label}, {n}³ elements", **style)
    right.loglog(1.0 - 2.0 * ratios, values / reference, **style)
for axes in (left, right):
    axes.set_xticks(1.0 - 2.0 * ratios, [f"{nu:g}" for nu in ratios], minor=False)
    axes.xaxis.set_minor_locator(plt.NullLocator())
    axes.invert_xaxis()
    axes.set_xlabel("Poisson's ratio, spaced as log(1 − 2 ν)")
left.set(ylabel="force for 15 % compression (N)", title="Force", ylim=(0, None))
left.legend(fontsize=8)
right.set(ylabel="force / force of the finest mean-dilatation mesh", title="Locking")
plt.show()
