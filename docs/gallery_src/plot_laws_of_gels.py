"""
Four laws of the same gel
=========================

Laws with the same moduli at small strain part where strains are large: stress of a bar of gel (E 20 kPa, Poisson's ratio 0.45) that is
compressed and stretched while its sides are free, from the closed solutions of `naibu.validation.uniaxial`.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.mechanics import material
from naibu.validation import uniaxial

stretch = np.linspace(0.6, 1.5, 46)
figure, axes = plt.subplots(figsize=(5.5, 4), layout="constrained")
for law, dashes in (("neo_hookean", "-"), ("mooney_rivlin", "--"), ("yeoh", "-."), ("saint_venant_kirchhoff", ":")):
    gel = material(law, young_modulus=20.0, poisson_ratio=0.45)
    stress = [uniaxial(gel, s).nominal_stress[2] for s in stretch]
    axes.plot(stretch, stress, dashes, label=law.replace("_", " "))
axes.plot(stretch, 20.0 * (stretch - 1.0), color="0.7", zorder=0, label="linear")
axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
axes.set(xlabel="stretch", ylabel="nominal stress (kPa)", title="Uniaxial compression and tension")
axes.legend(fontsize=8)
plt.show()
