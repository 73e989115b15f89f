"""
From scans to a prediction, where the truth is known
====================================================

A virtual gel of two layers with 64 washers inside is compressed by a plate and scanned three times by a virtual CT scanner, each time in
another pose. The washers are detected and linked in the volumes, the moduli are identified from the first compressed state, and the second
one is predicted. The ground truth is known, so that every step can be judged. The gel is computed on a finer mesh than the one on which it
is identified.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial import cKDTree

import naibu
from naibu.core import Loading
from naibu.identification import ModelSettings
from naibu.imaging import track_markers
from naibu.io import write_experiment_folder
from naibu.validation import box_experiment, scanned_states, virtual_specimen

HEIGHTS = {"pressed": 35.0, "pressed_more": 32.0}
TRUTH = {
    "soft: young_modulus": 100.0,  # kPa
    "firm: young_modulus": 200.0,
    "soft: poisson_ratio": 0.47,
    "firm: poisson_ratio": 0.47,
    "soft on table: friction": 0.35,
    "firm on acrylic: friction": 0.35,
}
described = box_experiment(
    "gel", (40.0, 40.0, 40.0), [("soft", 20.0), ("firm", 20.0)], Loading("plate"), HEIGHTS, spacing_mm=8.0, margin_mm=8.0
)
gel = virtual_specimen(described, TRUTH, settings=ModelSettings(element_size_mm=6.7), jitter_mm=0.3, seed=3)
scans = scanned_states(gel, spacing_mm=(0.7, 0.7, 0.7), seed=5)

# %%
# One slice of the scans of the reference and of a compressed state; circles are the washers detected within a millimetre of it.

tracked = track_markers([scan.volume for scan in scans.values()], diameter_mm=2.8, thickness_mm=0.3, polarity="bright", names=list(scans))

figure, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained", sharey=True)
for shown, name, markers in zip(axes, scans, tracked.markers, strict=False):
    volume = scans[name].volume
    row = int(np.rint(volume.to_index(markers.points)[:, 1].mean() + 4.0 / 0.7))
    low, high = volume.to_physical([0, row, 0]), volume.to_physical(np.array([volume.shape[2] - 1, row, volume.shape[0] - 1]))
    drawn = shown.imshow(
        volume.values[:, row], origin="lower", extent=(low[0], high[0], low[2], high[2]), cmap="gray", vmin=0, vmax=2500, aspect="equal"
    )
    near = np.abs(markers.points[:, 1] - low[1]) < 1.0
    shown.plot(markers.points[near, 0], markers.points[near, 2], "o", mfc="none", mec="tab:orange", ms=10)
    shown.set(title=name, xlabel="x, mm")
axes[0].set_ylabel("z, mm")
figure.colorbar(drawn, ax=axes, label="intensity")
plt.show()

for scan, name, markers in zip(scans.values(), tracked.names, tracked.markers, strict=True):
    missed = cKDTree(scan.markers.points).query(markers.points[np.isfinite(markers.points).all(axis=1)])[0]
    print(f"{name}: {len(missed)} of {len(gel.free)} washers detected, median centre error {np.median(missed):.3f} mm")

# %%
# The markers are written to a folder, and treated as measured ones from here on. The moduli of the firm gel are known.

xy_sd, z_sd = tracked.typical_sd_mm
with tempfile.TemporaryDirectory() as aside:
    folder = write_experiment_folder(
        Path(aside) / "gel",
        tracked.markers[0],
        tracked.states,
        title="A virtual gel, scanned",
        shape=described.shape,
        loading=described.loading,
        layers=described.layers,
        stated_mm=HEIGHTS,
        spacing_mm=described.nominal_spacing_mm,
        xy_sd_mm=xy_sd,
        z_sd_mm=z_sd,
    )
    settings = ModelSettings(element_size_mm=10.0)
    found = naibu.identify(folder, known=["firm=200 kPa"], settings=settings, states={"gel": ["pressed"]})
    unseen = naibu.predict(found.model, folder, state="pressed_more", heights_from_markers=True)

for parameter in found.model.parameters.free:
    if parameter.name in TRUTH:
        low, high = found.model.interval(parameter.name)
        print(
            f"{parameter.name}: {parameter.value:.3g} (95 % from {low:.3g} to {high:.3g}), truth {TRUTH[parameter.name]:g} {parameter.unit}"
        )

# %%
# Displacement of the washers in the state that was not used, and distance from their predicted to their detected positions.

moved = np.linalg.norm(unseen.measured_in_object - unseen.specimen.marker_points, axis=1)
missed = np.linalg.norm(unseen.residual, axis=1)
figure, shown = plt.subplots(figsize=(7, 4), layout="constrained")
drawn = shown.scatter(moved, missed, c=unseen.specimen.marker_points[:, 2], cmap="viridis")
shown.set(xlabel="displacement of the washer, mm", ylabel="distance to its prediction, mm")
shown.set_ylim(bottom=0.0)
shown.set_title(f"pressed to 32 mm, predicted from 35 mm: {np.sqrt(np.nanmean(missed**2)):.2f} mm RMS")
figure.colorbar(drawn, label="height in the reference configuration, mm")
plt.show()
