"""
4. Planning an experiment
=========================

How many points, which push, how small the noise: what the moduli will be known to, before anything is cast or scanned.
"""

# %%
# The body that is planned
# ------------------------
# Three parts; the upper half has a known modulus (0.4 kPa) and sets the scale. The moduli of the others are guessed: only their order
# matters here.
import matplotlib.pyplot as plt
import numpy as np

from naibu import DisplacementField
from naibu.identification import FieldLoadCase, Zones, expected_accuracy
from naibu.reproduction.chapter3.bodies import cube

guess = {"lower": (0.25, 0.43), "middle": (0.5, 0.38)}
body = cube(guess, known=(0.4, 0.43))
zones = Zones.of(body.mesh, known={"upper half": (0.4, 0.43)})


def planned(pushes: list[tuple[float, float, float]], sd_mm: float, every: int = 1) -> np.ndarray:
    """Return the relative standard deviations of Young's moduli for pushes, noise, and every n-th point measured."""
    cases = []
    for k, push in enumerate(pushes):
        points, moved = body.mesh.points[::every], body.displacement(push)[::every]
        field = DisplacementField.from_arrays(points, moved, sd_mm=sd_mm)
        cases.append(FieldLoadCase.of(f"push {k + 1}", field, body.mesh, loaded=body.constrained))
    young, poisson = np.array(list(guess.values())).T
    accuracy = expected_accuracy(body.mesh, cases, zones, young_modulus=young, poisson_ratio=poisson, elements="as_given")
    return accuracy.young_modulus_sd / young


# %%
# Which push
# ----------
# Pressing and shearing, alone and together, at a noise of 0.1 mm.
pushes = {
    "press": [(0.0, 0.0, -10.0)],
    "shear": [(10.0, 0.0, 0.0)],
    "press, then shear": [(0.0, 0.0, -10.0), (10.0, 0.0, 0.0)],
}
table = {name: planned(which, 0.1) for name, which in pushes.items()}
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
at = np.arange(len(table))
for k, (name, shift) in enumerate(zip(guess, (0.2, -0.2), strict=True)):
    axes.barh(at + shift, [100.0 * sd[k] for sd in table.values()], 0.36, label=name)
axes.set_yticks(at, list(table))
axes.set(xlabel="SD of Young's modulus (%)", ylabel="push")
axes.legend()
plt.show()
for name, sd in table.items():
    print(f"{name}: " + ", ".join(f"{part} {100.0 * value:.2g} %" for part, value in zip(guess, sd, strict=True)))

# %%
# How many points
# ---------------
# The standard deviation falls with the square root of the number of points, and in proportion to the noise.
steps = (1, 2, 4)
counts = [len(body.mesh.points[::every]) for every in steps]
figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
for noise in (0.05, 0.2):
    spread = [100.0 * planned(pushes["press"], noise, every).max() for every in steps]
    axes.loglog(counts, spread, "o-", label=f"noise {noise:g} mm")
axes.set(xlabel="points measured", ylabel="largest SD of a modulus (%)")
axes.set_xticks(counts, [str(count) for count in counts])
axes.xaxis.set_minor_formatter("")
axes.legend()
plt.show()
