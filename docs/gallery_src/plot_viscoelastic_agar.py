"""
Agar that is pushed, held and let go
====================================

A plane three-element body (a Voigt element in series with a dashpot): a plate pushes the middle of its top down, holds it, and lets go.
What has flowed stays.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import LinearBody, PrescribedMotion, Support, simulate_motion, three_element
from naibu.meshing import rectangle

mesh = rectangle((60.0, 30.0), (24, 12))
x, y = mesh.points.T
push = PrescribedMotion.through([0.0, 1.0], [(0.0, 0.0), (0.0, -5.0)])
supports = [
    Support("floor", np.flatnonzero(y < 1e-9)),
    Support("plate", np.flatnonzero((y > 30.0 - 1e-9) & (abs(x) < 10.1)), motion=push, end_s=3.0),
]
agar = three_element(10.0, 6.0, 60.0, poisson_ratio=0.4)
series = simulate_motion(LinearBody.of(mesh), agar, 1e-6, supports, np.linspace(0.0, 6.0, 121))

figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained", width_ratios=(1.2, 1.2, 1))
for axes, step, title in ((panels[0], 60, "held, 3 s"), (panels[1], 120, "3 s after it was let go")):
    moved = mesh.points + series.displacement[step]
    size = np.linalg.norm(series.displacement[step], axis=1)
    painted = axes.tripcolor(*moved.T, mesh.cells[:, :3], size, shading="gouraud", cmap="viridis", vmin=0.0, vmax=5.0)
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
figure.colorbar(painted, ax=panels[:2], label="displacement (mm)", shrink=0.8)
panels[2].plot(series.times, -series.force("plate")[:, 1] / 1000.0)
panels[2].set(xlabel="time (s)", ylabel="force of the plate (N)")
plt.show()
