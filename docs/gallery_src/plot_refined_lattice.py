"""
A mesh that follows the deformation
===================================

A cantilever of springs under a load at its end: edges that stretch are bisected, so that nodes gather where the strain is.
"""

import matplotlib.pyplot as plt

from naibu.meshing import EdgeStretch, box
from naibu.simulation import AdaptiveLattice, Conditions, SpringMaterial, face_force

mesh = box((100.0, 100.0, 100.0), (4, 4, 4), cell_type="tetra", centred=False)
pull = face_force(lambda x: x[:, 0] > 99.9, (0.0, 0.0, -8e3))
conditions = Conditions(lambda x: x[:, 0] < 0.1, loads=(pull,))
lattice = AdaptiveLattice.of(mesh, SpringMaterial(50.0, 1e-7), conditions, EdgeStretch(1.05, 1.02), step=5e-4)

figure, panels = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained", sharey=True)
for axes, steps in zip(panels, (0, 50, 50), strict=True):
    if steps:
        lattice.step(steps=steps)
    points = lattice.positions()
    painted = axes.scatter(points[:, 0], points[:, 2], c=points[:, 1], s=6, cmap="viridis", vmin=0.0, vmax=100.0)
    axes.set(title=f"{lattice.lattice.n_nodes} nodes", xlabel="x (mm)", aspect="equal")
panels[0].set_ylabel("z (mm)")
figure.colorbar(painted, ax=panels, label="y (mm)", shrink=0.8)
plt.show()
