"""
Distance to rigid indenters
===========================

Every indenter is a signed distance with its derivatives, and the same for finite elements and lattices. A new shape is a new distance; see
:func:`naibu.mechanics.capsule_geometry` and its neighbours.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import bar_geometry, box_geometry, capsule_geometry, cylinder_geometry, sphere_geometry

shapes = {
    "sphere": sphere_geometry(12.0),
    "capsule, axis x": capsule_geometry(7.0, 20.0, (1.0, 0.0, 0.0)),
    "cylinder, axis z": cylinder_geometry(12.0, 24.0),
    "box": box_geometry((28.0, 10.0, 18.0)),
    "bar along y": bar_geometry("y", 20.0, corner_radius_mm=3.0),
}
x, z = np.meshgrid(np.linspace(-30.0, 30.0, 121), np.linspace(-30.0, 30.0, 121))
points = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])

figure, panels = plt.subplots(1, 5, figsize=(12, 3), layout="constrained", sharey=True)
for axes, (name, shape) in zip(panels, shapes.items(), strict=True):
    distance = shape.distance(points).reshape(x.shape)
    painted = axes.contourf(x, z, distance, levels=np.arange(-12, 33, 4), cmap="cividis", extend="both")
    axes.contour(x, z, distance, levels=[0.0], colors="white")
    axes.set(title=name, xlabel="x (mm)", aspect="equal")
panels[0].set_ylabel("z (mm)")
figure.colorbar(painted, ax=panels, label="distance (mm)", shrink=0.8)
plt.show()
