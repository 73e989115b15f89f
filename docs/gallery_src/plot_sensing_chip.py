"""
What a force-sensing chip can bear and tell
===========================================

The cross-beam chip of the 2008 report in closed forms: its sensitivity to a force and two moments, and the largest load that it bears.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.applications import assumed_chip, closed_form_sensitivities, load_limits

chip = assumed_chip()
names = ("force along z", "moment about x", "moment about y")
sensitivities, limits = closed_form_sensitivities(chip), load_limits(chip)
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2), layout="constrained")
left.bar(names, np.abs(sensitivities), color="#2a788e")
left.set(xlabel="load", ylabel="sensitivity (mV/mN, mV/(N µm))")
right.bar(("force (mN)", "moment (N µm)"), limits[:2], color="#d95f02")
right.set(xlabel="load", ylabel="largest load that is borne")
left.tick_params(axis="x", labelsize=7)
plt.show()
print("sensitivities:", sensitivities.round(3), " limits:", limits.round(0))
