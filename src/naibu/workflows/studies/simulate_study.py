"""Simulations of the 2008 report :cite:p:`hirai2008` (chapter 2), written as a series for ParaView, an animated page and JSON."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np

from naibu._version import __version__
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.vtk_files import write_vtkhdf_series
from naibu.reproduction.chapter2.simulations import NAMES, SQUARES, Study, run
from naibu.viewer.animation import MovingBody, animation_html
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

SLUGS = {name.replace(",", "").replace(" ", "-").lower(): name for name in NAMES}
SQUARES_TOGETHER = "squares"


@no_empty_folders()
def simulate_study(name: str, out: str | os.PathLike[str], *, overwrite: bool = False, progress: Progress | None = None) -> list[Path]:
    """Run a named study; write ``STUDY.vtkhdf``, ``STUDY.json`` and, for plane studies, the animation ``STUDY.html``.

    Parameters
    ----------
    name : str
        ``"elastic-square"``, ``"agar-block"``, ...; ``"squares"`` runs the three squares and animates them side by side.
    out : path-like
        Folder of the files.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` before every study.

    Returns
    -------
    list of Path
        The files, the page first where there is one.

    Raises
    ------
    InputError
        There is no study of this name, or the folder cannot be written, or holds results.
    """
    if name != SQUARES_TOGETHER and name not in SLUGS:
        raise InputError(f"there is no study {name!r}; choose one of {', '.join([SQUARES_TOGETHER, *SLUGS])}")
    names = SQUARES if name == SQUARES_TOGETHER else (SLUGS[name],)
    slugs = [slug for slug, title in SLUGS.items() if title in names]
    written = [f"{name}.html", *(f"{slug}.{ending}" for slug in slugs for ending in ("vtkhdf", "json"))]
    folder = output_folder(out, written, overwrite=overwrite)
    studies: list[Study] = []
    files: list[Path] = []
    for each in names:
        report_progress(progress, f"simulate {name}", done=len(studies), total=len(names))
        studies.append(run(each))
        files += _written(studies[-1], folder)
    if all(study.mesh.dimension == 2 for study in studies):
        files.insert(0, write_atomically(folder / f"{name}.html", _page(studies)))
    return files


def _written(study: Study, folder: Path) -> list[Path]:
    slug = next(s for s, name in SLUGS.items() if name == study.name)
    series = study.series
    path = folder / f"{slug}.vtkhdf"
    speed, force = series.velocity, series.reaction
    values = {"displacement_mm": series.displacement, "velocity_mm_per_s": speed, "support_force_mN": force}
    write_vtkhdf_series(path, study.mesh, series.times, values)
    numbers = {
        "study": study.name,
        "naibu": __version__,
        "material": asdict(study.material),
        "units": "mm, kg, s, mN, kPa, kPa s",
        "method": series.method,
        "steps": series.steps,
        "times_s": series.times.tolist(),
        "middle_of_the_pushed_face_mm": series.displacement[:, study.middle_top].tolist(),
        "forces_mN": {s.name: series.force(s.name).tolist() for s in series.supports},
        "kinetic_mN_mm": series.kinetic.tolist(),
        "elastic_mN_mm": series.elastic.tolist(),
        "dissipated_mN_mm": series.dissipated.tolist(),
    }
    text = json.dumps(numbers, indent=1).replace("Infinity", '"infinite"')
    return [path, write_atomically(folder / f"{slug}.json", text + "\n")]


def _page(studies: list[Study]) -> str:
    bodies = tuple(
        MovingBody(s.name, s.mesh.points, s.mesh.cells, s.series.displacement, np.linalg.norm(s.series.displacement, axis=2))
        for s in studies
    )
    title = "Squares, pushed and released" if len(studies) > 1 else studies[0].name.capitalize()
    sentences = [f"{s.name.capitalize()}: {_described(s)}." for s in studies]
    return animation_html(title, studies[0].series.times, bodies, "displacement, mm", sentences)


def _described(study: Study) -> str:
    m = study.material
    parts = [f"E {m.young_modulus:g} kPa", f"Poisson's ratio {m.poisson_ratio:g}"]
    parts += [f"C1 {m.voigt_viscosity:g} kPa s"] if m.voigt_viscosity > 0.0 else []
    parts += [f"C2 {m.series_viscosity:g} kPa s"] if np.isfinite(m.series_viscosity) else []
    return ", ".join(parts)
