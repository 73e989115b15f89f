"""
Compress a two-layer block between plates with friction
=======================================================

A cube of 60 mm has a soft lower and a firm upper half. A rigid plate compresses it to 45 mm on a table. The bulging of the sides and the
reaction force depend on the friction between gel and plates.
"""

# %%
# A block and its materials
# -------------------------
# `naibu.meshing.box` puts element faces on the boundary between the layers. Moduli are in kPa. Both gels are nearly
# incompressible, as real gels are.
import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import (
    Assembler,
    Contact,
    Friction,
    PrescribedDisplacement,
    Problem,
    Solution,
    block_pattern,
    elements,
    material,
    plane_geometry,
    rigid_contact,
    solve,
)
from naibu.meshing import boundary_faces, box

SIDE_MM, PRESSED_MM = 60.0, 45.0
mesh = box((SIDE_MM, SIDE_MM, SIDE_MM), (8, 8, 8), layers=[("soft", 30.0), ("firm", 30.0)])
gels = [material(young_modulus=30.0, poisson_ratio=0.49), material(young_modulus=90.0, poisson_ratio=0.49)]


# %%
# Rigid contact with friction
# ---------------------------
# A rigid indenter is a surface with a prescribed path. All faces of the block may come into contact with table and plate: side faces may
# roll onto the plates. No displacement is prescribed; friction alone constrains the block.
def pressed(coefficient: float) -> Solution:
    """Compress the block between plates with a given friction coefficient."""
    faces = boundary_faces(mesh).faces

    def body_of(name: str, normal: tuple[float, float, float], start_mm: float, stop_mm: float) -> Contact:
        path = {"start": (0.0, 0.0, start_mm), "stop": (0.0, 0.0, stop_mm)}
        friction = Friction(coefficient)
        return rigid_contact(name, mesh.points, faces, plane_geometry(normal), **path, friction=friction, normal_stiffness=2e4)

    contacts = (body_of("table", (0, 0, 1), 0.0, 0.0), body_of("plate", (0, 0, -1), SIDE_MM, PRESSED_MM))
    body = elements(mesh)
    pattern = block_pattern(mesh.n_points, body.connectivity, *(contact.nodes for contact in contacts))
    assembler = Assembler.from_materials(body, mesh.regions, gels, pattern)
    nothing, no_weight = PrescribedDisplacement.none(mesh.n_points), np.zeros_like(mesh.points)
    return solve(Problem(mesh.points, assembler, contacts, nothing, no_weight))


coefficients = (0.05, 0.1, 0.2, 0.4, 0.8)
solutions = [pressed(coefficient) for coefficient in coefficients]
forces = [-solution.reactions["plate"][2] / 1000 for solution in solutions]  # N
for coefficient, force, solution in zip(coefficients, forces, solutions, strict=True):
    print(f"friction {coefficient:4.2f}: plate force {force:6.1f} N, {solution.status.value}")

# %%
# Bulge and reaction
# ------------------
# The soft half expands more. Friction constrains the faces at the plates, so that the sides bulge and the force increases.
edge = np.flatnonzero((np.abs(mesh.points[:, 0] - SIDE_MM / 2) < 1e-6) & (np.abs(mesh.points[:, 1]) < 1e-6))
edge = edge[np.argsort(mesh.points[edge, 2])]
colours = plt.colormaps["viridis"](np.linspace(0.0, 0.9, len(coefficients)))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for coefficient, solution, colour in zip(coefficients, solutions, colours, strict=True):
    x, _, z = (mesh.points + solution.displacement)[edge].T
    left.plot(x, z, "o-", color=colour, markersize=3, label=f"friction {coefficient:g}")
left.axvline(SIDE_MM / 2, color="0.6", linewidth=1, linestyle=":")
left.set(xlabel="x on the centre line of the side (mm)", ylabel="height z (mm)", title="Side of the compressed block")
left.legend(fontsize=8)
right.plot(coefficients, forces, "o-", color="0.2")
right.set(xlabel="friction coefficient", ylabel="force on the plate (N)", title="Force for 25 % compression")
right.set_ylim(0, None)

# %%
# The deformed section
# --------------------
# Displacement of the section y = 0 for the largest friction coefficient.
section = np.flatnonzero(np.abs(mesh.points[:, 1]) < 1e-6)
shape = (9, 9)  # nodes along z and x
deformed = (mesh.points + solutions[-1].displacement)[section].reshape(*shape, 3)
magnitude = np.linalg.norm(solutions[-1].displacement[section], axis=1).reshape(shape)

figure, axes = plt.subplots(figsize=(5.5, 4), layout="constrained")
painted = axes.pcolormesh(deformed[..., 0], deformed[..., 2], magnitude, shading="gouraud", cmap="viridis")
axes.plot(deformed[4, :, 0], deformed[4, :, 2], color="white", linewidth=1)
axes.annotate("interface of the layers", deformed[4, 4, [0, 2]], color="white", ha="center", va="bottom", fontsize=8)
axes.set(xlabel="x (mm)", ylabel="z (mm)", title="Section through the compressed block", aspect="equal")
figure.colorbar(painted, label="displacement (mm)", shrink=0.6)
plt.show()
