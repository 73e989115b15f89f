"""
Moduli from a displacement field
================================

The displacement inside a body of three parts is known with noise, and the moduli of its upper half are known: FEMU finds those of the
others, each with its interval.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu import DisplacementField
from naibu.identification import FieldLoadCase, Zones, identify_field
from naibu.reproduction.chapter3.bodies import cube

truth = {"lower": 0.25, "middle": 0.5}
body = cube({"lower": (0.25, 0.43), "middle": (0.5, 0.38)}, known=(0.4, 0.43))
rng = np.random.default_rng(0)
moved = body.displacement((0.0, 0.0, -10.0))
results = {}
for sd in (0.01, 0.03, 0.1):
    field = DisplacementField.from_arrays(body.mesh.points, moved + sd * rng.standard_normal(moved.shape), sd_mm=sd)
    load_case = FieldLoadCase.of("push", field, body.mesh, loaded=body.constrained)
    zones = Zones.of(body.mesh, known={"upper half": (0.4, 0.43)})
    found = identify_field(body.mesh, [load_case], zones, elements="as_given")
    results[sd] = dict(zip(found.zones.names, found.young_modulus, strict=True))

figure, axes = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
for name, colour in zip(truth, ("#2a788e", "#d95f02"), strict=True):
    axes.semilogx(list(results), [r[name] for r in results.values()], "o-", color=colour, label=name)
    axes.axhline(truth[name], color=colour, linewidth=1, linestyle=":")
axes.set(xlabel="noise of the displacement (mm)", ylabel="Young's modulus (kPa)", title="Found (points) and true (dotted)")
axes.legend()
plt.show()
