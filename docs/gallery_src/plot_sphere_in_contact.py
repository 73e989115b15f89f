"""
A sphere pressed into a lattice
===============================

A rigid sphere with friction goes down onto a block of dough on a table, and up again: contact begins where they touch, and the force
falls behind on the way back.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import LatticeEngine, box_mask, classic_lattice, lattice_parameters, plane_indenter, push, spherical_indenter

lattice = classic_lattice(box_mask((5, 5, 4)), 16.0, total_mass_kg=0.5)
parameters = lattice_parameters(lattice, stiffness=40.0, voigt_damping=20.0, series_damping=300.0)
engine = LatticeEngine.of(lattice, parameters, step=0.002)
bodies = [
    plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.4),
    spherical_indenter((40, 40, 90), 25.0, static_friction=0.3),
]
path = np.zeros((600, 2, 3))
path[:400, 1, 2], path[400:, 1, 2] = -20.0, 20.0  # mm/s
pushed = push(engine, engine.rest(), bodies, path)
depth = np.cumsum(-path[:, 1, 2]) * 0.002
force = -pushed.reaction[:, 1, 2] / 1000.0

figure, axes = plt.subplots(figsize=(5.5, 3.8), layout="constrained")
axes.plot(depth[:400], force[:400], label="down")
axes.plot(depth[400:], force[400:], "--", label="up")
axes.set(xlabel="path of the sphere (mm)", ylabel="force (N)", title="A sphere of 25 mm on dough")
axes.legend()
plt.show()
