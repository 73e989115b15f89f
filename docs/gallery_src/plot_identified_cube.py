"""
Identify a compressed gel, and predict further compression
==========================================================

A gel cube with 125 markers inside was measured by CT under a plate at two heights. Friction, Poisson's ratio and the true height and tilt
of the plate are identified from the first height alone; the marker positions at the second are then predicted. Coarse elements keep this
quick; omit ``settings`` for the best result.
"""

import matplotlib.pyplot as plt
import numpy as np

import naibu
from naibu.identification import ModelSettings

found = naibu.identify("ct_cube_plate", states={"ct_cube_plate": ["height_45"]}, settings=ModelSettings(element_size_mm=12.0))
unseen = naibu.predict(found.model, "ct_cube_plate", state="height_35", heights_from_markers=True)

for parameter in found.model.parameters.free:
    low, high = found.model.interval(parameter.name)
    print(f"{parameter.name}: {parameter.value:.4g}, 95 % from {low:.4g} to {high:.4g} {parameter.unit}")

# %%
# Prediction error against displacement of the markers. The size of a symbol is the predicted standard deviation of a
# coordinate.

free, measured = unseen.specimen.marker_points, unseen.measured_in_object
moved = np.linalg.norm(measured - free, axis=1)
missed = np.linalg.norm(unseen.residual, axis=1)
spread = np.sqrt((unseen.sd_mm**2).mean(axis=1))

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
drawn = axes.scatter(moved, missed, s=200.0 * spread, c=free[:, 2], cmap="viridis")
axes.set_xlabel("displacement of the marker, mm")
axes.set_ylabel("prediction error, mm")
axes.set_ylim(bottom=0.0)
axes.set_title(f"ct_cube_plate at 35 mm, predicted from 45 mm: {np.sqrt(np.nanmean(missed**2)):.2f} mm RMS")
figure.colorbar(drawn, label="height in the undeformed cube, mm")
plt.show()
