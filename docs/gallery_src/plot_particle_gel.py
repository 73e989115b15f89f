"""
Stiffness from particles in a gel
=================================

Two clouds of particles, seen before and after a gel was pressed, with 15 % lost and some invented, are linked. Their displacement,
with its covariance, tells the modulus of the lower gel; that of the upper one is known. On the command line: ``naibu track`` and then
``naibu identify``.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.identification import FieldLoadCase, Zones, identify_field
from naibu.imaging import particle_motion
from naibu.validation import QuadraticBody

rng = np.random.default_rng(0)
body = QuadraticBody("cube")
points, u = body.solved((0.0, 0.0, -2.0), divisions=4).at(rng.uniform(0.02, 0.98, (2000, 3)))
clouds = []
for there in (points, points + u):
    seen = there[rng.uniform(size=len(there)) > 0.15]
    seen = seen + [0.01, 0.01, 0.03] * rng.standard_normal(seen.shape)
    invented = rng.uniform(points.min(axis=0), points.max(axis=0), (60, 3))
    clouds.append(rng.permutation(np.concatenate([seen, invented])))
motion = particle_motion(*clouds)

mesh, loaded = body.model(8, "hexahedron")
zones = Zones.of(mesh, known={"known": body.known})
found = identify_field(mesh, [FieldLoadCase.of("press", motion.field, mesh, loaded=loaded)], zones)
low, high = found.intervals()[0][0]

linked = motion.field.points[motion.field.valid]
moved = motion.field.vectors[motion.field.valid]
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.8), layout="constrained", width_ratios=(2, 1))
middle = np.abs(linked[:, 1] - np.median(linked[:, 1])) < 4.0
xz, way = linked[middle][:, [0, 2]], moved[middle][:, [0, 2]]
arrows = left.quiver(*xz.T, *way.T, way[:, 1], angles="xy", scale_units="xy", scale=0.5)
figure.colorbar(arrows, ax=left, label="displacement along z (mm)")
left.set(xlabel="x (mm)", ylabel="z (mm)", title="Linked particles in a slab", aspect="equal")
right.errorbar([0], found.young_modulus, yerr=[[found.young_modulus[0] - low], [high - found.young_modulus[0]]], fmt="o", capsize=6)
right.axhline(body.unknown[0], color="grey", linestyle=":")
right.set(xticks=[], xlim=(-1, 1), xlabel="lower gel", ylabel="Young's modulus (kPa)", title="Found and true (dotted)")
plt.show()
