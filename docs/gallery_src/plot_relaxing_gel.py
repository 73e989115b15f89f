"""
A gel relaxes under a plate
===========================

A block at finite strain, compressed by a fifth within a second and held: the force rises, and relaxes as its Prony series says.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import Assembler, PrescribedDisplacement, Problem, PronySeries, elements, material, simulate_viscoelastic
from naibu.meshing import box

mesh = box((60.0, 60.0, 60.0), (4, 4, 4))
bottom, top = (np.flatnonzero(np.isclose(mesh.points[:, 2], z)) for z in (0.0, 60.0))
gel = material("neo_hookean_isochoric", young_modulus=125.0, poisson_ratio=0.49)
body = Assembler.from_materials(elements(mesh), mesh.regions, [gel])
prescribed = PrescribedDisplacement.none(mesh.n_points).and_also(bottom, (0.0, 0.0, 0.0)).and_also(top, (0.0, 0.0, -12.0))
problem = Problem(mesh.points, body, (), prescribed, np.zeros_like(mesh.points))
times = np.concatenate([np.linspace(0.0, 1.0, 5), np.geomspace(1.2, 12.0, 9)])

figure, axes = plt.subplots(figsize=(5.5, 3.8), layout="constrained")
for weights, label in (((0.0, 0.0), "elastic"), ((0.3, 0.2), "g = 0.3 (0.5 s), 0.2 (4 s)")):
    found = simulate_viscoelastic(problem, PronySeries(weights, (0.5, 4.0)), times=times, loads=np.minimum(times, 1.0))
    force = [-step.internal_force[top, 2].sum() / 1000.0 for step in found.steps]
    axes.plot([step.time for step in found.steps], force, "o-", markersize=3, label=label)
axes.set(xlabel="time (s)", ylabel="force on the plate (N)", title="Compressed by 20 % in 1 s, and held")
axes.set_ylim(0.0, None)
axes.legend(fontsize=8)
plt.show()
