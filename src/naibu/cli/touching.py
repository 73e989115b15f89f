"""Verbs of bodies that are touched: ``live``, ``cut``."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from naibu.cli.console import app, errors, progress_display, say

if TYPE_CHECKING:
    from naibu.workflows.touchable_models import MeshMaterial


@app.command
def live(
    source: str = "demo",
    *,
    experiment: str | None = None,
    young_modulus_kpa: float | None = None,
    poisson_ratio: float | None = None,
    port: int = 8765,
    haptics_port: int | None = None,
    browser: bool = True,
) -> None:
    """Touch a simulated body in the browser: push it, pull it, look inside and read the force.

    The page is served to this computer only; Ctrl-C ends it.

    Parameters
    ----------
    source
        demo, the gels that naibu demo identifies; model.json of an identification or its folder; a mesh (.vtu, .msh); or a lattice study,
        STUDY.toml or a name from naibu simulate.
    experiment
        Experiment whose body an identified model is made for, if not the first one that it was identified from.
    young_modulus_kpa
        Young's modulus of a mesh, kPa; 10 by default.
    poisson_ratio
        Poisson's ratio of a mesh; 0.45 by default.
    port
        Port of this computer; 0 takes a free one.
    haptics_port
        UDP port of this computer at which a haptic device leads the tool, such as 8766; the body must be a lattice.
    browser
        Open the page in the browser.
    """
    from naibu.workflows.live import live as served

    def ready(address: str) -> None:
        say(f"Live page: {address}")
        if haptics_port is not None:
            say(f"Haptic device: UDP, 127.0.0.1:{haptics_port}")
        errors.print("Ctrl-C ends it.", soft_wrap=True)
        if browser:
            webbrowser.open(address)

    served(
        source, experiment=experiment, material=_material(young_modulus_kpa, poisson_ratio), port=port,
        haptics_port=haptics_port, ready=ready,
    )  # fmt: skip


@app.command
def cut(
    source: str,
    *,
    path: Path,
    out: Path = Path("naibu-cut"),
    distance_mm: float | None = None,
    pull_percent: float = 5.0,
    experiment: str | None = None,
    young_modulus_kpa: float | None = None,
    poisson_ratio: float | None = None,
    overwrite: bool = False,
) -> None:
    """Cut a mesh or an identified model along the path of a blade, pull the cut open, and write mesh, motion, page and numbers.

    Parameters
    ----------
    source
        demo, model.json of an identification or its folder, or a mesh (.vtu, .msh).
    path
        CSV table of the blade's edge: each row a pose, x, y, z in mm of the edge's first vertex, then of the second, and so on.
    out
        Folder for cut.html, cut.vtu (mesh with its pieces), cut.vtkhdf (motion) and cut.json.
    distance_mm
        Twice the largest distance of the cut from the blade; half of the mean edge of the mesh by default.
    pull_percent
        How far the ends along the axis that the cut crosses most are pulled apart, in per cent of their distance, so that the cut opens.
    experiment
        Experiment whose body an identified model is made for, if not the first one that it was identified from.
    young_modulus_kpa
        Young's modulus of a mesh, kPa; 10 by default.
    poisson_ratio
        Poisson's ratio of a mesh; 0.45 by default.
    overwrite
        Replace results that the folder holds.
    """
    from naibu.workflows.cut import cut as run

    with progress_display() as progress:
        done = run(
            source, path, out=out, distance_mm=distance_mm, pull_percent=pull_percent, experiment=experiment,
            material=_material(young_modulus_kpa, poisson_ratio), overwrite=overwrite, progress=progress,
        )  # fmt: skip
    sizes = ", ".join(f"{volume:.4g}" for volume in done.volumes_mm3[:6])
    say(f"{done.cut.n_pieces} piece(s) of {sizes} mm3; the cut deviates from the blade by {done.cut.deviation_mm:.2g} mm at most.")
    say(f"Page: {done.files[0]}   {', '.join(str(file) for file in done.files[1:])}")


def _material(young_modulus_kpa: float | None, poisson_ratio: float | None) -> MeshMaterial | None:
    """Return the material of a mesh, None where nothing of it is stated."""
    from naibu.workflows.touchable_models import MeshMaterial

    given = {"young_modulus_kpa": young_modulus_kpa, "poisson_ratio": poisson_ratio}
    stated = {name: value for name, value in given.items() if value is not None}
    return MeshMaterial(**stated) if stated else None
