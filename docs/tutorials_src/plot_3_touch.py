"""
3. A soft body to push at 1 kHz
===============================

A lattice is calibrated on captured data, and then stepped in Python by a loop of one millisecond, as a haptic device would drive it.
``naibu live`` with ``--haptics-port`` does the same for a device over UDP, with limits on force, change of force and energy
(:doc:`/live`). The first run on a computer compiles the kernels of lattices, which takes more than a minute, in Python without a word;
``naibu doctor --warm`` does it ahead.
"""

# %%
# Captured data
# -------------
# Shapes of a block of dough while two stamps squeeze it, hold it and let go. They are simulated here; points of a depth camera have the
# same form.
import time

import matplotlib.pyplot as plt
import numpy as np

from naibu.identification import CalibrationProblem, LatticeUnknowns, PushedFace, Pushing, calibrate_lattice
from naibu.mechanics import IndenterVelocity, LatticeEngine, plane_indenter, spherical_indenter
from naibu.validation import dough_lattice, virtual_capture

block = dough_lattice(25.0, size_cm=(10, 5, 7.5))
squeeze = Pushing(
    "squeeze",
    (
        PushedFace((0.0, 0.0, 25.0), (0.0, 50.0, 50.0), (20.0, 0.0, 0.0)),
        PushedFace((100.0, 0.0, 25.0), (100.0, 50.0, 50.0), (-20.0, 0.0, 0.0)),
    ),
    push_s=0.4,
    keep_s=0.4,
    free_s=0.4,
    capture_s=(0.0, 0.2, 0.4, 0.8, 1.2),
)
unknowns = LatticeUnknowns.of(block, classes=False)
truth = unknowns.parameters(unknowns.vector({"K": 100.0, "C1": 50.0, "C2": 150.0}))
capture = virtual_capture(block, truth, squeeze, seed=0, points=300)

# %%
# Calibrate
# ---------
# Stiffness, damping and flow of the elements, each with its interval, from a start that is off by a factor of two.
found = calibrate_lattice(CalibrationProblem.of(block, [capture], unknowns), {"K": 50.0, "C1": 100.0, "C2": 80.0})
print(*found.sentences()[:3], sep="\n")

# %%
# Push it
# -------
# A session holds the state; a step takes velocities of the indenters (mm/s) and returns what the body exerts on them (mN). Here a sphere
# goes down for a third of a second and stays.
lattice, parameters = block, unknowns.parameters(found.values)
engine = LatticeEngine.of(lattice, parameters, step=0.001)
middle = lattice.points.mean(axis=0)
top = lattice.points[:, 2].max()
table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.5)
sphere = spherical_indenter((middle[0], middle[1], top + 21.0), 20.0, static_friction=0.3)
force, took = [], []
with engine.session(indenters=[table, sphere]) as session:
    for step in range(1000):
        down = -40.0 if step < 330 else 0.0
        began = time.perf_counter()
        forces = session.step(motions=[IndenterVelocity((0.0, 0.0, 0.0)), IndenterVelocity((0.0, 0.0, down))]).indenters[-1]
        took.append(time.perf_counter() - began)
        force.append(forces[1, 2] / 1000.0)

figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
axes.plot(0.001 * np.arange(1000), np.abs(force))
axes.set(xlabel="time (s)", ylabel="force on the sphere (N)", title="Pushed by 13 mm, then held")
plt.show()
print(f"a step took {1e3 * np.median(took):.2f} ms in the median on this machine")
