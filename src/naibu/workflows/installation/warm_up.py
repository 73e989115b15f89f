"""Compilation of kernels ahead of their first use: a small problem of every kind, as the verbs solve them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from naibu._numba.reports import reported_compilation
from naibu.applications.sensing_chip.bridge import sensitivity_matrix
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.finite_elements import solve_chip
from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import NaibuError
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.imaging.measure_displacement import Method
from naibu.io.images import write_volume
from naibu.mechanics.finite_elements.assembly import LARGE, Assembler
from naibu.mechanics.finite_elements.elements import Formulation, elements
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, from_moduli
from naibu.meshing.primitives import box
from naibu.workflows.interactive.cut_kernels import compile_for_cuts
from naibu.workflows.interactive.preparation import compile_for
from naibu.workflows.interactive.touchable_models import touchable
from naibu.workflows.markers.identify import identify
from naibu.workflows.measurement.sense import sense
from naibu.workflows.measurement.track import track
from naibu.workflows.measurement.track_sequence import track_sequence_file
from naibu.workflows.predict import predict
from naibu.workflows.studies.simulate import simulate

SIZE_MM = 32
SENSED: tuple[Method, ...] = ("default", "features", "sad-blocks", "horn-schunck", "lucas-kanade")  # whose kernels the others share
STUDY = """
title = "warm-up"

[object]
size_mm = [40, 30, 30]
mass_g = 40

[lattice]
kind = "{kind}"
spacing_mm = {spacing}

[parameters]
K = 10.0
C1 = 0.01
C2 = 0.02

[simulation]
duration_s = 0.05
step_s = {step}
method = "{method}"
gravity_mm_per_s2 = 9810

[floor]
contact = "{contact}"

[[indenter]]
name = "box"
shape = "box"
size_mm = [20, 20, 10]
centre_mm = [20.0, 15.0, 35.0]
contact = "{contact_of_box}"
path = [[0.0, 0, 0, 0], [0.05, 0, 0, -1]]
"""


@dataclass(frozen=True, slots=True)
class WarmUp:
    """What was compiled.

    Attributes
    ----------
    kernels : int
        Number of kernels compiled; 0 where all were there.
    seconds : float
        Time of all.
    failed : tuple of str
        Problems that could not be solved, each with the reason.
    """

    kernels: int
    seconds: float
    failed: tuple[str, ...]


def warm_up(progress: Progress | None = None) -> WarmUp:
    """Compile the kernels of every verb by solving small problems in a temporary folder.

    Parameters
    ----------
    progress : callable, optional
        Called before every problem and after every kernel.
    """
    start, compiled, failed = time.monotonic(), 0, []
    stage = ""

    def listen(kernel: str, done: bool) -> None:
        nonlocal compiled
        compiled += done
        report_progress(progress, f"{stage}: {kernel}", done=compiled)

    with reported_compilation(listen), tempfile.TemporaryDirectory(prefix="naibu-warm-up-") as folder:
        for stage, problem in _problems(Path(folder)).items():
            report_progress(progress, stage, done=compiled)
            try:
                problem()
            except NaibuError as error:
                failed.append(f"{stage}: {error}")
    return WarmUp(compiled, time.monotonic() - start, tuple(failed))


def _problems(folder: Path) -> dict[str, Callable[[], object]]:
    reference, deformed = folder / "reference.mha", folder / "deformed.mha"
    model = folder / "model"
    problems: dict[str, Callable[[], object]] = {
        "identify": partial(
            identify, "ct_two_material_1", known=("hardness 5=222 kPa",), settings=ModelSettings(element_size_mm=25.0), out=model
        ),
        "predict": partial(predict, model, "ct_two_material_2", out=folder / "prediction"),
        "large meshes": _large_meshes,
        "chip": _chip,
        "live": _live,
        "track": partial(_track, folder),
        "track-sequence": partial(_track_sequence, folder),
    }
    _write_texture(reference, deformed)
    for method in SENSED:
        problems[f"sense, {method}"] = partial(_sense, reference, deformed, method)
    for name, values in {
        "implicit": {"kind": "classic", "spacing": 10.0, "step": 0.002, "method": "implicit", "contact": "friction"},
        "implicit-tied": {"kind": "octree-1", "spacing": 5.0, "step": 0.002, "method": "implicit", "contact": "sticking"},
        "explicit": {"kind": "classic", "spacing": 10.0, "step": 0.0002, "method": "symplectic_euler", "contact": "sticking"},
    }.items():
        study = folder / f"{name}.toml"
        tied = "tied" if values["contact"] == "sticking" else "friction"
        study.write_text(STUDY.format(**values, contact_of_box=tied), encoding="utf-8")
        problems[f"simulate, {name}"] = partial(simulate, study, out=folder / name)
    return problems


def _large_meshes() -> None:
    """Assemble meshes of more than `LARGE` cells, which have kernels of their own."""
    n = int(np.ceil(LARGE ** (1 / 3))) + 1
    kinds: tuple[tuple[str, Formulation], ...] = (("hexahedron", "mean_dilatation"), ("tetra", "standard"))
    for cell_type, formulation in kinds:
        mesh = box((float(n),) * 3, (n,) * 3, cell_type=cell_type)
        made = Assembler.from_materials(elements(mesh, formulation), mesh.regions, [from_moduli(LAWS["neo_hookean"], 10.0, 50.0)])
        made.evaluate(np.zeros(mesh.points.shape))
        made.forces(np.zeros(mesh.points.shape))


def _chip() -> None:
    """Solve the beams of a sensing chip, and read their piezoresistors."""
    sensitivity_matrix(solve_chip(assumed_chip(), ChipResolution(along=2, across=1, through=1), whole=False))


def _live() -> None:
    """Touch what `naibu live` shows without an argument, and cut a small body, with and without friction of the sides."""
    compile_for(touchable("demo").body)
    for friction in (0.0, 0.4):
        compile_for_cuts(friction)


def _write_texture(reference: Path, deformed: Path) -> None:
    rng = np.random.default_rng(0)
    values = gaussian_filter(rng.normal(size=(SIZE_MM, SIZE_MM + 4, SIZE_MM + 8)), 1.5)
    for path, shift in ((reference, 0), (deformed, 1)):
        _write(path, np.roll(1000.0 * values, shift, axis=2).astype(np.float32))


def _write(path: Path, values: AnyArray) -> None:
    write_volume(path, Volume(values, np.ones(3), np.zeros(3), np.eye(3)))


def _sense(reference: Path, deformed: Path, method: Method) -> None:
    sense(reference, deformed, method=method, out=reference.parent / f"sensed-{method}")


def _balls(centres: FloatArray, radius: float, shape: tuple[int, ...]) -> FloatArray:
    grid = np.stack(np.meshgrid(*(np.arange(float(n)) for n in shape), indexing="ij"), axis=-1)
    distance = np.sqrt(((grid[..., None, :] - centres) ** 2).sum(axis=-1)).min(axis=-1)
    return np.asarray(np.clip(radius + 0.5 - distance, 0.0, 1.0))


def _track(folder: Path) -> None:
    rng = np.random.default_rng(1)
    lattice = np.stack(np.meshgrid(*(np.arange(8.0, SIZE_MM, 12.0),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    scans = [folder / "initial.mha", folder / "pressed.mha"]
    for k, path in enumerate(scans):
        values = 100.0 * _balls(lattice + 0.7 * k, 2.0, (SIZE_MM,) * 3) + rng.normal(size=(SIZE_MM,) * 3)
        _write(path, values.astype(np.float32))
    track(scans, out=folder / "beads", diameter_mm=4.0)
    track(scans, out=folder / "washers", diameter_mm=4.0, thickness_mm=2.0)


def _track_sequence(folder: Path) -> None:
    rng = np.random.default_rng(2)
    centres = np.array([[16.0, 16.0], [16.0, 44.0], [44.0, 30.0]])
    shape = (60, 60)
    frames = [200.0 * _balls(centres + np.array([0.5 * k, 0.0]), 3.0, shape) + 20.0 * rng.random(shape) for k in range(6)]
    _write(folder / "frames.mha", np.array(frames, dtype=np.float32))
    track_sequence_file(folder / "frames.mha", out=folder / "sequence", pixel_mm=1.0, diameter_mm=6.0, count=3)
