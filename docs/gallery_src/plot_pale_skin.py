"""
Skin that turns pale and recovers
=================================

Two-layered viscoelastic skin under an air jet for half a second (active ischemia): the indentation, and the area whose capillaries the
pressure empties.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.applications import LayeredModes, SkinLayer, SkinPatch, SurfaceLoad, meshed, simulate_skin
from naibu.mechanics import three_element

layers = three_element(0.5, 1.0, 30.0, 0.49), three_element(3.8, 0.03, 30.0, 0.49)  # kPa, kPa s
patch = SkinPatch(tuple(SkinLayer(0.5, layer) for layer in layers), width_mm=4.0, kinematics="axisymmetric")
load = SurfaceLoad(force_mn=5.0, duration_s=0.47, radius_mm=0.5)
modes = LayeredModes.of(meshed(patch, load.radius_mm, across=12, upwards=8))
times = np.linspace(0.005, 3.0, 150)
motion = simulate_skin(modes, layers, load, times)

figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2), layout="constrained")
left.plot(times, 1000.0 * motion.indentation, color="#2a788e")
left.set(xlabel="time (s)", ylabel="indentation (µm)")
for pressure in (0.3, 0.5, 1.0):
    right.plot(times, motion.pale_area(pressure), label=f"above {pressure:g} kPa")
right.set(xlabel="time (s)", ylabel="pale area (mm$^2$)")
right.legend(fontsize=8)
plt.show()
