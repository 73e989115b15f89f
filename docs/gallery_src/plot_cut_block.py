"""
Cut a block along the path of a blade
=====================================

A blade sweeps through a block of tetrahedra; cells near its path are bisected until the cut follows it, then separated. The pieces are
exactly as large as the block was.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.meshing import box, cut_volume, signed_volumes, swept_blade

mesh = box((40.0, 40.0, 40.0), (4, 4, 4), cell_type="tetra", centred=False)
steps = np.linspace(-5.0, 45.0, 12)
height = 20.0 + 6.0 * np.sin(steps / 8.0)
edges = np.stack([[(x, -5.0, z), (x, 45.0, z)] for x, z in zip(steps, height, strict=True)])
cut = cut_volume(mesh, swept_blade(edges), 4.0)
print(f"{cut.n_pieces} pieces; volume {np.abs(signed_volumes(cut.mesh)).sum():.1f} of 64000 mm3")

middle = cut.mesh.points[cut.mesh.cells].mean(axis=1)
near = np.abs(middle[:, 1] - 20.0) < 4.0
figure, axes = plt.subplots(figsize=(4.8, 4.2), layout="constrained")
painted = axes.scatter(middle[near, 0], middle[near, 2], c=cut.piece[near], s=10, cmap="coolwarm")
axes.plot(steps, height, color="black", linewidth=1.5, label="path of the blade")
axes.set(xlabel="x (mm)", ylabel="z (mm)", title="Elements by piece, in a slice", aspect="equal", xlim=(-2, 42), ylim=(-2, 42))
axes.legend(loc="upper right", fontsize=8)
plt.show()
