"""
Methods of sensing side by side
===============================

The same pair of scans by digital volume correlation and by classic methods. The mean of the error hides what the 95th percentile shows.
"""

import matplotlib.pyplot as plt
import numpy as np

from naibu.imaging import end_point_error, measure_displacement
from naibu.validation import squeezed_ball

reference, deformed, truth, mask = squeezed_ball(seed=2)
methods = ("rigid", "horn-schunck", "lucas-kanade", "ncc-blocks", "default")
errors = [
    end_point_error(measure_displacement(reference, deformed, method=method, mask=mask).displacement.vectors, truth, mask)
    for method in methods
]
figure, axes = plt.subplots(figsize=(6.5, 3.4), layout="constrained")
at = np.arange(len(methods))
axes.barh(at + 0.2, [e.mean_mm for e in errors], 0.38, color="#2a788e", label="mean")
axes.barh(at - 0.2, [e.p95_mm for e in errors], 0.38, color="#fde725", edgecolor="0.4", label="95th percentile")
axes.set_yticks(at, methods)
axes.set(xlabel="error of the displacement (mm)", ylabel="method")
axes.legend()
plt.show()
