"""
A lattice at haptic rates
=========================

A cube of 80 mm and 0.63 kg as a mass-spring-dashpot lattice, pushed from above and let go, step by step as a haptic loop would do it.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import ConstrainedNodes, LatticeEngine, box_mask, classic_lattice, lattice_parameters

lattice = classic_lattice(box_mask((4, 4, 4)), 20.0, total_mass_kg=0.63)
height = lattice.points[:, 2]
floor = ConstrainedNodes.of(np.flatnonzero(height == 0.0), body=0)
stamp = ConstrainedNodes.of(np.flatnonzero(height == 80.0), body=1)
velocity = np.zeros((500, 2, 3))
velocity[:, 1, 2] = -10.0  # mm/s, for a second

figure, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
for series_damping in (60.0, 200.0, 1e6):  # mN s/mm: from dough to nearly elastic
    parameters = lattice_parameters(lattice, stiffness=40.0, voigt_damping=20.0, series_damping=series_damping)
    engine = LatticeEngine.of(lattice, parameters, step=0.002)
    pushed = engine.run(engine.rest(), 500, floor + stamp, velocity)
    held = engine.run(pushed.state, 500, floor + stamp, np.zeros((500, 2, 3)))
    force = np.concatenate([pushed.reaction[:, 1, 2], held.reaction[:, 1, 2]]) / -1000.0
    axes.plot(0.002 * np.arange(1, 1001), force, label=f"C2 = {series_damping:g} mN s/mm")
axes.set(xlabel="time (s)", ylabel="force on the stamp (N)", title="Pushed by 10 mm in a second, then held")
axes.legend(fontsize=8)
plt.show()
