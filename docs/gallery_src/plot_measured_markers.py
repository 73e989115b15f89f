"""
Explore measured markers
========================

naibu includes measurements: positions of markers cast into gels, before and after compression, from computed tomography. Your own
measurements are read in the same way from a folder, by `naibu.io.read_experiment`.
"""

# %%
# Read an experiment
# ------------------
# An experiment has a shape, layers of materials, a loading and states. The first state is the reference configuration (unloaded).
import matplotlib.pyplot as plt
import numpy as np

from naibu import datasets

print("bundled:", ", ".join(datasets.names()))
experiment = datasets.load("ct_two_material_2")
print(experiment.title)
for layer in experiment.layers:
    print(f"  {layer.from_base_mm:g} to {layer.to_base_mm:g} mm above the base: {layer.material}")
for problem in experiment.known_problems:
    print("  known problem:", problem)

# %%
# Markers are matched by their labels. `aligned` returns positions in the order of given labels, NaN where a marker or one of its
# coordinates is missing, or suspect. A marker without y still has x and z.
free, loaded = experiment.initial, experiment.loaded_states[0]
before, after = free.aligned(free.ids), loaded.markers.aligned(free.ids)
moved = after - before
for axis, count in zip("xyz", np.isfinite(moved).sum(axis=0), strict=True):
    print(f"{axis} is known in both states of {count} of {len(free)} markers")

# %%
# Before and after
# ----------------
# Coordinates are those of the scanner. The plate presses from above: the upper layers move down most, and all layers expand laterally.
figure, panels = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained", sharey=True)
for axes, axis in zip(panels, (0, 1), strict=True):
    seen = np.isfinite(moved[:, axis] + moved[:, 2])
    a, b = before[seen][:, [axis, 2]], after[seen][:, [axis, 2]]
    axes.plot(*np.stack([a, b], axis=1).T, color="0.8", linewidth=0.7, zorder=1)
    axes.plot(*a.T, "o", color="0.7", markersize=4, label="unloaded")
    down = {"c": -moved[seen, 2], "cmap": "viridis", "vmin": 0, "vmax": -np.nanmin(moved[:, 2])}
    painted = axes.scatter(*b.T, **down, s=18, label="compressed", zorder=3)
    axes.set(xlabel=f"{'xyz'[axis]} in the scanner (mm)", aspect="equal")
panels[0].set_ylabel("z in the scanner (mm)")
panels[0].legend(loc="upper right", fontsize=8)
figure.colorbar(painted, ax=panels, label="downward displacement (mm)")
figure.suptitle(f"Markers of {experiment.name}, unloaded and compressed")

# %%
# Strain of each layer
# --------------------
# The mean height of every marker layer gives the strain between layers without any model: the softer gel is compressed more.
# The origin of z may differ between scans, but differences of heights do not depend on it.
seen = np.isfinite(moved[:, 2])
above_base = before[seen, 2] - experiment.base_z_mm
nearest = np.abs(above_base[:, None] - experiment.nominal_heights_mm).argmin(axis=1)
pressed = above_base + moved[seen, 2]
heights = np.array([[z[nearest == k].mean() for z in (above_base, pressed)] for k in np.unique(nearest)])
strain = np.diff(heights[:, 1]) / np.diff(heights[:, 0]) - 1.0

figure, axes = plt.subplots(figsize=(5.5, 4), layout="constrained")
for low, high, value in zip(heights[:-1, 0], heights[1:, 0], 100 * strain, strict=True):
    axes.plot([value, value], [low, high], "-", color="0.2", linewidth=3)
    axes.text(value + 0.8, 0.5 * (low + high), f"{value:.0f} %", va="center", fontsize=8)
for layer, colour in zip(experiment.layers, ("tab:blue", "tab:orange"), strict=True):
    axes.axhspan(layer.from_base_mm, layer.to_base_mm, alpha=0.12, color=colour)
    axes.text(-1, layer.to_base_mm - 1, layer.material, ha="right", va="top", fontsize=8)
axes.set(xlim=(-50, 0), ylim=(0, 60), title=f"Strain of {experiment.name}")
axes.set(xlabel="vertical strain between marker layers (%)", ylabel="height above the base, unloaded (mm)")
plt.show()
