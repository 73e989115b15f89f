"""
How accurate will an experiment be
==================================

Before anything is measured: the standard deviation of the moduli that a push will leave, by the Fisher information, for several noises.
Twice the noise is twice the uncertainty; a body pushed twice as far halves it.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu import DisplacementField
from naibu.identification import FieldLoadCase, Zones, expected_accuracy
from naibu.reproduction.chapter3.bodies import cube

body = cube({"lower": (0.25, 0.43), "middle": (0.5, 0.38)}, known=(0.4, 0.43))
zones = Zones.of(body.mesh, known={"upper half": (0.4, 0.43)})
noises = (0.02, 0.1, 0.3)
figure, axes = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
for push_mm, dashes in ((5.0, "--"), (10.0, "-")):
    moved = body.displacement((0.0, 0.0, -push_mm))
    spread = []
    for sd in noises:
        field = DisplacementField.from_arrays(body.mesh.points, moved, sd_mm=sd)
        case = FieldLoadCase.of("push", field, body.mesh, loaded=body.constrained)
        planned = expected_accuracy(body.mesh, [case], zones, young_modulus=(0.25, 0.5), poisson_ratio=(0.43, 0.38), elements="as_given")
        spread.append(100.0 * planned.young_modulus_sd / np.array([0.25, 0.5]))
    for name, values, colour in zip(planned.names, np.array(spread).T, ("#2a788e", "#d95f02"), strict=True):
        axes.loglog(noises, values, dashes, color=colour, marker="o", markersize=4, label=f"{name}, pushed by {push_mm:g} mm")
axes.set(xlabel="noise of the displacement (mm)", ylabel="SD of Young's modulus (%)")
axes.set_xticks(noises, [f"{sd:g}" for sd in noises])
axes.xaxis.set_minor_formatter("")
axes.legend(fontsize=8)
plt.show()
