"""
Calibrate a lattice on captured shapes
======================================

Stiffness and damping of a block of dough from shapes that were captured while it was squeezed between two stamps. The capture is
simulated, so that the truth is known.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.identification import CalibrationProblem, LatticeUnknowns, PushedFace, Pushing, calibrate_lattice
from naibu.validation import dough_lattice, virtual_capture

block = dough_lattice(25.0, size_cm=(10, 5, 7.5))
squeeze = Pushing(
    "squeeze",
    (
        PushedFace((0.0, 0.0, 25.0), (0.0, 50.0, 50.0), (20.0, 0.0, 0.0)),
        PushedFace((100.0, 0.0, 25.0), (100.0, 50.0, 50.0), (-20.0, 0.0, 0.0)),
    ),
    push_s=0.4, keep_s=0.4, free_s=0.4, capture_s=(0.0, 0.2, 0.4, 0.8, 1.2),
)  # fmt: skip
truth = {"K": 100.0, "C1": 50.0, "C2": 150.0}
unknowns = LatticeUnknowns.of(block, classes=False)
capture = virtual_capture(block, unknowns.parameters(unknowns.vector(truth)), squeeze, seed=0, points=300)
start = {"K": 50.0, "C1": 100.0, "C2": 80.0}
found = calibrate_lattice(CalibrationProblem.of(block, [capture], unknowns), start)
print(*found.sentences(), sep="\n")

values = found.values
figure, axes = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
at = np.arange(3)
axes.plot(at, [start[name] / truth[name] for name in truth], "o", color="0.6", label="start")
axes.plot(at, values / np.array(list(truth.values())), "s", color="#2a788e", label="calibrated")
axes.axhline(1.0, color="0.4", linewidth=1, linestyle=":")
axes.set_xticks(at, list(truth))
axes.set(xlabel="parameter", ylabel="value over truth", ylim=(0.0, 2.2))
axes.legend()
plt.show()
