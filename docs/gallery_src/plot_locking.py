"""
Your own material, and why elements must not lock
=================================================

Gels and tissues hardly change their volume: Poisson's ratio is close to 0.5. Plain elements then become far too stiff. Elements that
average the change of volume (the default, ``"mean_dilatation"``) do not, and this script shows the difference.
"""

# %%
# A material of your own
# ----------------------
# Give Young's modulus (kPa) and Poisson's ratio at small strain. `naibu.mechanics.finite_elements.hyperelasticity.LAWS` lists the laws;
# for laws with more parameters, ``shape`` sets what the two moduli leave open.
import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import Formulation, elements
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.primitives import box
from naibu.meshing.surface import side_nodes

for law in LAWS.values():
    print(f"{law.name}: {', '.join(law.parameter_names)} (kPa)")
print(material("yeoh", young_modulus=60.0, poisson_ratio=0.49, shape=(0.1, 0.0)))

SIDE_MM, COMPRESSION = 40.0, 0.15


# %%
# A block between plates that stick
# ---------------------------------
# Bottom and top are held, the top moves down by 15 %. Returned is the force on the top.
def force(cells: int, poisson_ratio: float, formulation: Formulation) -> float:
    """Force (N) that presses a block with `cells` hexahedra an edge."""
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
# Towards incompressibility
# -------------------------
# Plain elements run away, and refining the mesh helps only slowly. Averaged ones stay where they should be, on a coarse mesh too.
ratios = np.array([0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499])
cells = (4, 8)
kinds: tuple[Formulation, ...] = ("mean_dilatation", "standard")
forces = {(n, kind): [force(n, nu, kind) for nu in ratios] for n in cells for kind in kinds}
reference = np.array(forces[8, "mean_dilatation"])
for (n, kind), values in forces.items():
    excess = 100 * (np.array(values) / reference - 1.0)
    print(f"{kind:16} {n}^3 elements: " + "  ".join(f"{e:+6.1f} %" for e in excess))

figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4), layout="constrained")
styles = {"mean_dilatation": ("tab:blue", "averaged dilatation"), "standard": ("tab:red", "plain")}
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
right.set(ylabel="force / force of the finest averaged mesh", title="Locking")
plt.show()
