"""
Which marker is which
=====================

2000 beads without numbers, compressed by 30 % and given in another order, are linked by relative positions of their neighbours.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.imaging import link_markers

rng = np.random.default_rng(0)
reference = rng.uniform(0.0, 60.0, (2000, 3))
order = rng.permutation(2000)
deformed = (reference * [1.2, 1.2, 0.7])[order]
links = link_markers(reference, deformed)
right = order[links.pairs[:, 1]] == links.pairs[:, 0]
print(f"{len(links)} of 2000 linked, {right.mean():.1%} right")

shown = np.abs(reference[links.pairs[:, 0], 1] - 30.0) < 2.0
a, b = reference[links.pairs[shown, 0]], deformed[links.pairs[shown, 1]]
figure, axes = plt.subplots(figsize=(5.5, 4.6), layout="constrained")
axes.plot(*np.stack([a[:, [0, 2]], b[:, [0, 2]]], axis=1).T, color="0.8", linewidth=0.8, zorder=1)
axes.plot(a[:, 0], a[:, 2], "o", color="0.6", markersize=3, label="free")
painted = axes.scatter(b[:, 0], b[:, 2], c=a[:, 2] - b[:, 2], s=14, cmap="viridis", zorder=3, label="compressed")
axes.set(xlabel="x (mm)", ylabel="z (mm)", title="Links in a slice of 4 mm", aspect="equal")
axes.legend(loc="upper right", fontsize=8)
figure.colorbar(painted, label="moved down (mm)")
plt.show()
