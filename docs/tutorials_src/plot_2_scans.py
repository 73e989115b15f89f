"""
2. Two scans to a stiffness map
===============================

From two scans of an object without markers to its displacement, its strain, and moduli of its parts. On the command line::

    naibu sense free.nii.gz pressed.nii.gz -o moved --open
    naibu identify moved/field.h5 --zones labels.nii.gz --zone-name gel=1 --zone-name core=2 -k 'gel=10 kPa'

Here the scans are virtual, so that the truth is known.
"""

# %%
# Scans
# -----
# naibu reads DICOM, NIfTI, NRRD, MetaImage, TIFF, HDF5 and Zarr, and keeps the frame of the scan: positions are in LPS (x to the left of
# the patient, y to the back, z upwards), which is the frame of DICOM, ITK and MetaImage. NIfTI files are in RAS and are converted; what
# naibu writes as NIfTI is in RAS again. Letters at the edges of the page (R/L, A/P, I/S) name the directions.
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import naibu
from naibu.io import read_displacement, write_volume
from naibu.validation import squeezed_ball

place = Path(tempfile.mkdtemp())
free, pressed, truth, mask = squeezed_ball(seed=3)
write_volume(place / "free.nii.gz", free)
write_volume(place / "pressed.nii.gz", pressed)
write_volume(place / "object.nii.gz", free.with_values(mask.astype(np.uint8)))

# %%
# Displacement
# ------------
# Nothing is tuned. What the scans do not show is left unanswered, and what they show has a standard deviation.
run = naibu.sense(place / "free.nii.gz", place / "pressed.nii.gz", mask=place / "object.nii.gz", out=place / "moved")
for name, value in run.rows()[:7]:
    print(f"{name}: {value if isinstance(value, str) else round(value, 4)}")

# %%
# Open ``displacement.mha`` in 3D Slicer (as a transform or a vector volume: both are LPS, nothing has to be turned) or
# ``displacement.vtu`` in ParaView, which holds strain and covariance too. In Python the same file is read back:
u, grid = read_displacement(place / "moved" / "displacement.mha")
z = mask.shape[0] // 2
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.6), layout="constrained")
dx, dy = grid.spacing_mm[:2]
extent = (0.0, dx * mask.shape[2], dy * mask.shape[1], 0.0)
painted = left.imshow(np.linalg.norm(u, axis=-1)[z], cmap="viridis", extent=extent)
left.set(title="displacement", xlabel="x (mm)", ylabel="y (mm)")
figure.colorbar(painted, ax=left, label="mm", shrink=0.8)
gradient = run.measured.gradient
stretch = np.linalg.norm(np.eye(3) + gradient[z], axis=(-2, -1)) / np.sqrt(3.0) - 1.0
painted = right.imshow(np.where(mask[z], 100.0 * stretch, np.nan), cmap="RdBu_r", vmin=-5, vmax=5, extent=extent)
right.set(title="mean stretch", xlabel="x (mm)", ylabel="y (mm)")
figure.colorbar(painted, ax=right, label="%", shrink=0.8)
plt.show()
error = np.linalg.norm(u - truth, axis=-1)[mask & run.measured.displacement.valid]
print(f"against the truth: median {np.median(error):.3f} mm, 95th percentile {np.percentile(error, 95):.3f} mm")

# %%
# Moduli
# ------
# ``moved/field.h5`` is what the identification takes, with a volume of labels for the parts and the modulus of one of them. How it is
# done is told in :doc:`/fields`, how far it can be trusted in :doc:`/field_checks`; :doc:`/gallery/plot_stiffness_of_zones` runs it on a
# body whose moduli are known.
print("files:", ", ".join(sorted(file.name for file in (place / "moved").iterdir())))
