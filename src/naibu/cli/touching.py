"""Verbs of bodies that are touched: ``live``, ``cut``."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naibu.cli.shell.console import errors, progress_display, say
from naibu.cli.shell.described import Out, Overwrite, Whole
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import TOUCH, verb
from naibu.core.errors import InputError

if TYPE_CHECKING:
    from naibu.workflows.interactive.touchable_models import MeshMaterial


@verb(
    TOUCH,
    "live                             # the gels of the demonstration",
    "live naibu-results               # the model that you identified",
    "live liver.vtu --young-modulus-kpa 5   # a mesh",
    "live fingertip                   # a soft fingertip that decodes what presses it",
    "live dough-pressed-by-sphere --haptics-port 8766   # a lattice, led by a haptic device",
)
def live(
    source: str = "demo",
    *,
    experiment: str | None = None,
    young_modulus_kpa: float | None = None,
    poisson_ratio: float | None = None,
    port: Whole = 8765,
    haptics_port: Whole | None = None,
    decoder: Path | None = None,
    lips_friction: float = 0.0,
    browser: bool = True,
) -> None:
    """Touch a simulated body in the browser: push, pull and cut it, look inside and read the force.

    The page is served to this computer only; Ctrl-C ends it.

    Parameters
    ----------
    source
        demo, the gels that naibu demo identifies; fingertip, a soft fingertip with a sensing chip; model.json of an identification or its
        folder; a mesh (.vtu, .msh); or the file of a lattice or a fingertip, STUDY.toml, or the name of a lattice from naibu simulate.
    experiment
        Experiment whose body an identified model is made for, if not the first one that it was identified from.
    young_modulus_kpa
        Young's modulus of a mesh, kPa; 10 by default.
    poisson_ratio
        Poisson's ratio of a mesh; 0.45 by default.
    port
        Port of this computer; 0 takes a free one.
    haptics_port
        UDP port of this computer at which a haptic device leads the tool, such as 8766.
    decoder
        Of your own fingertip: NAME-decoder.json, which naibu simulate writes of it.
    lips_friction
        Coefficient of friction between the two sides of a cut, of finite elements.
    browser
        Open the page in the browser.
    """
    from naibu.workflows.interactive.live import live as served

    def preparing() -> None:
        errors.print("preparing the simulation; the first run compiles kernels, a minute or two of one processor", soft_wrap=True)
        if haptics_port is not None:
            say(f"Haptic device: UDP, 127.0.0.1:{haptics_port}; answers carry flag 16, and no force, until the page is ready")

    def ready(address: str) -> None:
        say(f"Live page: {address}")
        errors.print("Ctrl-C ends it.", soft_wrap=True)
        if browser:
            webbrowser.open(address)

    served(
        source, experiment=experiment, material=_material(young_modulus_kpa, poisson_ratio), port=port,
        haptics_port=haptics_port, decoder=decoder, lips_friction=lips_friction, preparing=preparing, ready=ready,
    )  # fmt: skip


@verb(TOUCH, "cut demo --path blade.csv --open", "cut skin.stl --path tip.csv --tension-percent 8")
def cut(
    source: str,
    *,
    path: Path,
    out: Out = Path("naibu-cut"),
    distance_mm: float | None = None,
    pull_percent: float | None = None,
    lips_friction: float | None = None,
    experiment: str | None = None,
    young_modulus_kpa: float | None = None,
    poisson_ratio: float | None = None,
    tension_percent: float | None = None,
    groove_depth_mm: float | None = None,
    reach_mm: float | None = None,
    refine: bool | None = None,
    unit_mm: float | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Cut a mesh, an identified model, a lattice or a scanned surface, let the cut open, and write mesh, motion, page and numbers.

    A solid is cut along the path of a blade, and pulled apart. A surface is cut along the path of a tool's tip, and opens under tension.

    Parameters
    ----------
    source
        demo, model.json of an identification or its folder, a mesh (.vtu, .msh), a lattice study (STUDY.toml) or the name of one, or a
        surface (.stl, .ply, .obj, .wrl), which may be open.
    path
        CSV table. Of a blade: each row a pose, x, y, z in mm of the edge's first vertex, then of the second, and so on. Of the tip of a
        tool over a surface: each row x, y, z in mm.
    out
        Folder for cut.html, cut.vtu (mesh with its pieces), cut-surface.vtu (of solids: the faces of the cut), cut.vtkhdf (motion) and
        cut.json.
    distance_mm
        Twice the largest distance of the cut from the path; half of the mean edge of the mesh or surface by default. Lattices are not
        refined: a cut of theirs farther away is refused.
    pull_percent
        Solids: how far the ends along the axis that the cut crosses most are pulled apart, in per cent of their distance; 5 by default.
    lips_friction
        Finite elements: Coulomb's coefficient between the two sides of the cut; 0 by default. With friction the motion takes longer.
    experiment
        Experiment whose body an identified model is made for, if not the first one that it was identified from.
    young_modulus_kpa
        Young's modulus of a mesh, kPa; 10 by default.
    poisson_ratio
        Poisson's ratio of a mesh; 0.45 by default.
    tension_percent
        Surfaces: strain under which they are, %; 5 by default.
    groove_depth_mm
        Surfaces: depth of a groove, 0 for none; by default down to the tips that lie below the surface.
    reach_mm
        Surfaces: how far from the surface the tip still cuts; twice the distance by default.
    refine
        Surfaces: refine the triangles at the cut. Without it the cut follows the edges that there are.
    unit_mm
        Surfaces: length of the file's unit in mm, 1000 for metres; 1 by default.
    overwrite
        Replace results that the folder holds.
    """
    from naibu.workflows.interactive.cut import cut as run
    from naibu.workflows.interactive.cut import joined_text
    from naibu.workflows.interactive.cut_surface import is_surface, length_text

    solid = {
        "pull_percent": pull_percent, "lips_friction": lips_friction, "experiment": experiment, "young_modulus_kpa": young_modulus_kpa,
        "poisson_ratio": poisson_ratio,
    }  # fmt: skip
    sheet = {
        "tension_percent": tension_percent, "groove_depth_mm": groove_depth_mm, "reach_mm": reach_mm, "refine": refine, "unit_mm": unit_mm,
    }  # fmt: skip
    if is_surface(source):
        _require_unset(solid, f"goes with solids, and {source} is a surface")
        _cut_surface(source, path, out, distance_mm, overwrite, sheet)
        return
    _require_unset(sheet, f"goes with surfaces (.stl, .ply, .obj, .wrl), and {source} is none")
    with progress_display() as progress:
        done = run(
            source, path, out=out, distance_mm=distance_mm, experiment=experiment,
            material=_material(young_modulus_kpa, poisson_ratio), overwrite=overwrite, progress=progress,
            **({} if pull_percent is None else {"pull_percent": pull_percent}),
            **({} if lips_friction is None else {"lips_friction": lips_friction}),
        )  # fmt: skip
    wrote(*done.files)
    sizes = ", ".join(f"{volume:.0f}" if volume > 1e3 else f"{volume:.4g}" for volume in done.volumes_mm3[:6])
    say(
        f"{done.cut.n_pieces} piece{'s' * (done.cut.n_pieces > 1)} of {sizes} mm3; the cut deviates from the blade by "
        f"{length_text(done.cut.deviation_mm)} at most."
    )
    if earlier := joined_text(done.cut):
        say(earlier)
    say(f"Page: {done.files[0]}   {', '.join(str(file) for file in done.files[1:])}")


def _cut_surface(source: str, path: Path, out: Path, distance_mm: float | None, overwrite: bool, options: dict[str, Any]) -> None:
    from naibu.workflows.interactive.cut_surface import areas_text, incomplete_text, length_text
    from naibu.workflows.interactive.cut_surface import cut_surface_file as run

    stated = {name: value for name, value in options.items() if value is not None}
    with progress_display() as progress:
        done = run(source, path, out=out, distance_mm=distance_mm, overwrite=overwrite, progress=progress, **stated)
    wrote(*done.files)
    say(
        f"{done.cut.n_pieces} piece{'s' * (done.cut.n_pieces > 1)} of {areas_text(done.cut)} mm2; the cut deviates from the path by "
        f"{length_text(done.cut.deviation_mm)} at most, {length_text(done.cut.mean_deviation_mm)} on average."
    )
    for repair in done.cut.repairs:
        say(f"Before the cut: {repair}.")
    if incomplete := incomplete_text(done.cut, done.numbers["refined"]):
        say(incomplete)
    say(f"Page: {done.files[0]}   {', '.join(str(file) for file in done.files[1:])}")


def _require_unset(options: dict[str, Any], reason: str) -> None:
    """Refuse an option that does not belong to what is cut."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"`{name}` {reason}; leave it out")


def _material(young_modulus_kpa: float | None, poisson_ratio: float | None) -> MeshMaterial | None:
    """Return the material of a mesh, None where nothing of it is stated."""
    from naibu.workflows.interactive.touchable_models import MeshMaterial

    given = {"young_modulus_kpa": young_modulus_kpa, "poisson_ratio": poisson_ratio}
    stated = {name: value for name, value in given.items() if value is not None}
    return MeshMaterial(**stated) if stated else None
