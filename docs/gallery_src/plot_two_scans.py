"""
Displacement between two scans
==============================

Digital volume correlation of two virtual scans of a textured ball that is squeezed, where the displacement of every voxel is known:
what was measured, the standard deviation that was stated, and the error that was made.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.imaging import measure_displacement
from naibu.validation import squeezed_ball

reference, deformed, truth, mask = squeezed_ball(seed=1)
found = measure_displacement(reference, deformed, mask=mask)
u = found.displacement.vectors
error = np.where(mask, np.linalg.norm(u - truth, axis=-1), np.nan)
z = mask.shape[0] // 2

figure, panels = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained", sharey=True)
shown = (
    ("displacement (mm)", np.linalg.norm(u, axis=-1), "viridis"),
    ("stated standard deviation (mm)", np.where(mask, found.displacement.largest_sd_mm, np.nan), "cividis"),
    ("error (mm)", error, "magma"),
)
dx, dy = reference.spacing_mm[:2]
for axes, (name, values, colours) in zip(panels, shown, strict=True):
    painted = axes.imshow(values[z], cmap=colours, extent=(0.0, dx * mask.shape[2], dy * mask.shape[1], 0.0))
    figure.colorbar(painted, ax=axes, label=name, shrink=0.8)
    axes.set(xlabel="x (mm)")
panels[0].set_ylabel("y (mm)")
plt.show()
inside = mask & np.isfinite(error)
print(f"error: median {np.median(error[inside]):.3f} mm, 95th percentile {np.percentile(error[inside], 95):.3f} mm")
