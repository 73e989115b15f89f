"""
A point of one mammogram in the other
=====================================

Where a point of the craniocaudal view lies in the mediolateral oblique one: a curve with its band of uncertainty, by a geometric model of
compression. Research software, not a medical device.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.applications import breast_outline, mammographic_pair

turn = np.linspace(-np.pi / 2, np.pi / 2, 101)
cc = breast_outline(np.column_stack([110 * np.cos(turn), 80 * np.sin(turn)]))
skin = np.column_stack([112 * np.cos(turn), 85 * np.sin(turn)])
mlo = breast_outline(skin)
pair = mammographic_pair(cc, mlo, (60.0, 60.0), 45.0, seed=0, draws=40)

figure, axes = plt.subplots(figsize=(4.6, 4.6), layout="constrained")
axes.fill(*skin.T, color="0.93", zorder=0)
for point, colour in (((50.0, 20.0), "#2a788e"), ((70.0, -25.0), "#d95f02")):
    curve = pair.epipolar_curve(point).curve
    axes.plot(*curve.T, color=colour, label=f"of ({point[0]:g}, {point[1]:g}) mm in CC")
axes.set(xlabel="from the chest wall (mm)", ylabel="along the chest wall (mm)", title="In the oblique view", aspect="equal")
axes.legend(fontsize=8, loc="lower right")
plt.show()
