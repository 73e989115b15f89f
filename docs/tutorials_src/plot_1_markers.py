"""
1. My gel with markers
======================

From tables of marker positions to a calibrated model, its page, and a prediction. On the command line the same is::

    naibu import free.csv pressed.csv --size-mm 60 60 60 -l 'gel=0..60' --stated-mm pressed=45 --spacing-mm 10 -o my_gel
    naibu identify my_gel -k 'gel=200 kPa' --open

``naibu new -o my_gel`` writes the folder that this tutorial ends up with, with a comment to every key.
"""

# %%
# Tables
# ------
# A spreadsheet with a row for each marker: its number, and x, y, z. Numbers mean the same marker in every table. Here are two: those of a
# bundled measurement, in centimetres, as a spreadsheet may have them.
import csv
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import naibu
from naibu import datasets
from naibu.core import Layer, Loading, Shape
from naibu.identification import ModelSettings
from naibu.io import import_markers, write_experiment_folder

place = Path(tempfile.mkdtemp())
measured = datasets.load("ct_cube_plate")
for name, markers in (("free", measured.initial), ("pressed", measured.loaded_states[0].markers)):
    with open(place / f"{name}.csv", "w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["No.", "X [cm]", "Y [cm]", "Z [cm]"])
        table.writerows([number, *(point / 10.0)] for number, point in zip(markers.ids, markers.points, strict=True))
print((place / "free.csv").read_text()[:120])

# %%
# The unit stands in the column names, and is converted. An experiment folder adds what the tables do not say: shape, layers, loading.
free, pressed = (import_markers(place / f"{name}.csv") for name in ("free", "pressed"))
folder = write_experiment_folder(
    place / "my_gel",
    free,
    {"pressed": pressed},
    title="My gel under a plate",
    shape=Shape("box", (60.0, 60.0, 60.0)),
    loading=Loading("plate"),
    layers=(Layer("gel", 0.0, 60.0),),
    stated_mm={"pressed": 45.0},
    spacing_mm=10.0,
    xy_step_mm=0.29,
    z_step_mm=0.5,
)
print((folder / "meta.toml").read_text())

# %%
# Identify
# --------
# Displacements alone have no scale: the modulus of the gel is given (from a compression test, say), and Poisson's ratio, friction, the
# height of the plate and the pose of the scan are found. Elements of 12 mm are coarse, for the speed of this page.
found = naibu.identify(folder, known=["gel=200 kPa"], settings=ModelSettings(element_size_mm=12.0), out=place / "results")
print(found.verdict.sentence)
for parameter in found.model.parameters.free:
    low, high = found.model.interval(parameter.name)
    print(f"{parameter.name:34} {parameter.value:8.3f}  95 % [{low:.3f}, {high:.3f}] {parameter.unit}")

# %%
# What the model leaves: the distance of every marker from where the model puts it. ``results/report.html`` shows the same in 3-D.
rows = list(csv.DictReader((place / "results" / "residuals.csv").open()))
residual = np.array([[float(row[f"residual_{axis}_mm"] or "nan") for axis in "xyz"] for row in rows])
heights = dict(zip(free.ids.tolist(), free.points[:, 2], strict=True))
height = np.array([heights[int(row["marker"])] for row in rows])
figure, axes = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
for k, axis in enumerate("xyz"):
    axes.plot(residual[:, k], height + 0.8 * (k - 1), ".", label=f"along {axis}")
axes.axvline(0.0, color="0.7", linewidth=1)
axes.set(xlabel="predicted minus measured (mm)", ylabel="height of the marker (mm)", title="Residuals")
axes.legend()
plt.show()

# %%
# Predict
# -------
# The model predicts a load that was not measured, the plate at 40 mm, from the height of the plate alone. Every predicted position has a
# standard deviation.
prediction = naibu.predict(found.model, folder, state="pressed", height_mm=40.0, out=place / "predicted")
print(prediction.interval)
print("files:", ", ".join(sorted(file.name for file in (place / "predicted").iterdir())))
