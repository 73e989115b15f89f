"""
Meshes of solids, and how good their elements are
=================================================

Boxes with layers, cylinders and half ellipsoids are meshed with hexahedra; the scaled Jacobian of an element is 1 for a cube, and zero
for one that is folded flat.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.meshing import box, cylinder, half_ellipsoid, hemisphere, scaled_jacobians

meshes = {
    "box of two layers": box((60.0, 60.0, 60.0), (8, 8, 8), layers=[("soft", 30.0), ("firm", 30.0)]),
    "cylinder": cylinder(50.0, 40.0, 5.0),
    "half ellipsoid": half_ellipsoid((110.0, 130.0, 50.0), 8.0),
    "hemisphere": hemisphere(60.0, 6.0),
}
figure, panels = plt.subplots(1, 4, figsize=(12, 3.2), layout="constrained")
for axes, (name, mesh) in zip(panels, meshes.items(), strict=True):
    middle = mesh.points[mesh.cells].mean(axis=1)
    near = np.abs(middle[:, 1] - np.median(mesh.points[:, 1])) < 6.0
    painted = axes.scatter(middle[near, 0], middle[near, 2], c=scaled_jacobians(mesh)[near], s=14, cmap="viridis", vmin=0.0, vmax=1.0)
    axes.set(title=f"{name}: {len(mesh.cells)} elements", xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    axes.title.set_fontsize(9)
figure.colorbar(painted, ax=panels, label="scaled Jacobian", shrink=0.8)
plt.show()
