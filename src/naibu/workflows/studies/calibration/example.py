"""Inputs of a calibration to try it with: a study of dough, and what virtual cameras and force sensors recorded of it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.studies.study_model import StudyModel
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.io.files.atomic import write_atomically
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.lattice_study import prepared_study, study_text

SOURCE = "dough-first-pushing"
CAPTURE_S = (0.0, 0.5, 1.0, 3.0, 5.0)
POINTS, POINT_SD_MM = 2800, 0.5  # of the report :cite:p:`hirai2008`
SENSOR_HZ, FORCE_SD_MN = 400.0, 50.0
START = {"K": 50.0, "C1": 25.0, "C2": 100.0}  # the file's values, with which a search begins
FILES = ("dough.toml", "shapes.csv", "forces.csv")


@no_empty_folders()
def write_calibration_example(out: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False) -> tuple[Path, ...]:
    """Write a study with rough values, captured points and forces of a virtual dough, with noise.

    The dough has the parameters of the study ``dough-first-pushing``. Points lie anywhere on its surface but on the floor; sensors have a
    time base of their own, 400 samples a second, and three forces and three moments, the latter zero.

    Parameters
    ----------
    out : path-like
        Folder for ``dough.toml``, ``shapes.csv`` and ``forces.csv``.
    seed : int
        Of the noise.
    overwrite : bool
        Whether files that are there already are replaced.

    Raises
    ------
    InputError
        A folder that cannot be written to, or holds such files.
    """
    folder = output_folder(out, FILES, overwrite=overwrite)
    prepared = prepared_study(SOURCE)
    study, rng = prepared.study, np.random.default_rng(seed)
    unknowns = StudyUnknowns.of(study)
    steps = round(study.frames * study.frame_s / study.step_s)
    model = StudyModel.of(study, CAPTURE_S, steps, 1, coarse=False)
    found = model.run(unknowns.parameters(unknowns.start))
    triangles = model.hull.triangles
    triangles = triangles[(study.lattice.points[triangles][:, :, 2] > 0.0).any(axis=1)]
    shapes = ["time_s,x_mm,y_mm,z_mm"]
    for time, position in zip(CAPTURE_S, found.positions, strict=True):
        cloud = _spread(position[triangles], rng) + POINT_SD_MM * rng.standard_normal((POINTS, 3))
        shapes += [f"{time:g},{x:.3f},{y:.3f},{z:.3f}" for x, y, z in cloud]
    times = np.arange(0.5 / SENSOR_HZ, steps * study.step_s, 1.0 / SENSOR_HZ)
    forces = ["time_s,indenter,Fx_N,Fy_N,Fz_N,Mx_Nmm,My_Nmm,Mz_Nmm"]
    for k, body in enumerate(study.bodies):
        if body.name != "floor":
            seen = found.force[np.minimum((times / study.step_s).astype(int), steps - 1), k] + FORCE_SD_MN * rng.standard_normal(
                (len(times), 3)
            )
            forces += [f"{t:.5f},{body.name},{x:.4f},{y:.4f},{z:.4f},0,0,0" for t, (x, y, z) in zip(times, 1e-3 * seen, strict=True)]
    text = study_text(SOURCE)
    for kind, value in START.items():
        line = next(line for line in text.splitlines() if line.startswith(f"{kind} = "))
        text = text.replace(line, f"{kind} = {value}")
    text = text.replace("of a virtual dough; the report's own are not printed", "rough values, from which naibu calibrate starts")
    texts = (text, "\n".join(shapes) + "\n", "\n".join(forces) + "\n")
    return tuple(write_atomically(folder / name, content) for name, content in zip(FILES, texts, strict=True))


def _spread(triangles: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return points spread evenly over triangles (t, 3, 3)."""
    a, b, c = triangles.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(area), POINTS, p=area / area.sum())
    u, w = rng.random((2, POINTS))
    over = u + w > 1.0
    u, w = np.where(over, 1.0 - u, u)[:, None], np.where(over, 1.0 - w, w)[:, None]
    return np.asarray(a[chosen] + u * (b - a)[chosen] + w * (c - a)[chosen])
