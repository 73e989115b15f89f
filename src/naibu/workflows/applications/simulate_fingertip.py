"""Run a fingertip from its file: page, numbers, readings, a decoder of forces, and the motion of the last press for ParaView."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu._version import __version__
from naibu.applications.fingertip.decoder import train_decoder
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.fingertip.slip import SlipDetector, train_slip_detector
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.filters import first_order_filter
from naibu.applications.sensing_chip.load_envelope import require_bearable
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.study_schemas.fingertip_schema import DECODER
from naibu.io.vtk_files import write_vtkhdf_series
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Cell
from naibu.workflows.applications.fingertip_checkpoint import FingertipCheckpoint
from naibu.workflows.applications.fingertip_page import FingertipResults, fingertip_cards, fingertip_sections
from naibu.workflows.applications.fingertip_study import PreparedFingertip, in_keys, prepared_fingertip
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.simulate_lattice import SimulationRun

_FREE_S = 0.5  # before and after a press in the recorded readings


@dataclass(slots=True)
class _Computed:
    """Presses computed so far: those of the training, then those of the file."""

    presses: tuple[Press, ...]
    done: list[Pressing]


@no_empty_folders()
def simulate_fingertip(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SimulationRun:
    """Compute a fingertip.

    Writes ``NAME.html``, ``NAME.json``, ``NAME-readings.csv`` and, for ParaView, ``NAME.vtkhdf``, of the last press, and
    ``NAME-decoder.json`` where the file asks for a decoder. KeyboardInterrupt keeps the presses that are done.

    Parameters
    ----------
    source : str or path-like
        ``"fingertip"``, or a file.
    out : path-like
        Folder of the files.
    resume : bool
        Whether an interrupted run is resumed.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` before each press and after each of its load steps.

    Raises
    ------
    InputError
        A file that cannot be used, a press that is too strong for the fingertip or its chip, nothing to resume, or a folder that cannot be
        written to or holds results.
    ConvergenceError
        No equilibrium was found under a press.
    """
    study = prepared_fingertip(source)
    names = [f"{study.name}{ending}" for ending in (".html", ".json", ".vtkhdf", "-readings.csv")]
    names += [f"{study.name}-decoder.json"] if study.training else []
    folder = output_folder(out, () if resume else names, overwrite=overwrite)
    checkpoint = FingertipCheckpoint.of(folder, study.name, study.source, study.digest)
    trained = study.training.presses(study.fingertip) if study.training else ()
    slides = study.training.slides(study.fingertip) if study.training else ()
    run = _Computed((*trained, *slides, *study.presses), [])
    run.done = checkpoint.read(run.presses) if resume else []
    model = FingertipModel.of(study.fingertip, study.resolution)
    try:
        _compute(study, model, run, checkpoint, progress)
    except KeyboardInterrupt:
        if not run.done:
            raise
        checkpoint.write(run.done)
        return SimulationRun((checkpoint.path,), len(run.done), len(run.presses), "presses")
    except InputError as error:
        raise InputError(f"{study.source}: {in_keys(str(error))}") from error
    results = _results(study, model, run, (len(trained), len(slides)))
    files = _written(study, results, folder)
    checkpoint.remove()
    return SimulationRun(files, len(run.presses), len(run.presses))


def _compute(
    study: PreparedFingertip, model: FingertipModel, run: _Computed, checkpoint: FingertipCheckpoint, progress: Progress | None
) -> None:
    """Compute the presses that are missing; the last one, whose displacements are kept, is never taken from a checkpoint."""
    count = len(run.presses)
    del run.done[count - 1 :]
    for k in range(len(run.done), count):
        reached = [0.0]  # a press that slides has a second way

        def tell(fraction: float, k: int = k, reached: list[float] = reached) -> None:
            reached[0] = max(reached[0], fraction)
            report_progress(progress, f"simulate {study.name}: press {k + 1} of {count}", done=k + 0.99 * reached[0], total=count)

        tell(0.0)
        pressing = model.pressed(run.presses[k], keep_displacement=k == count - 1, callback=tell)
        of_file = k - (count - len(study.presses))
        if of_file >= 0:
            try:
                require_bearable(study.chip.design, *np.abs(_loads(study, of_file, pressing)[:, 2:5]).max(axis=0))
            except InputError as error:
                raise InputError(f"[[press]] number {of_file + 1}, on the chip: {error}") from error
        run.done.append(pressing)
        if k < count - 1:
            checkpoint.write(run.done)


def _loads(study: PreparedFingertip, k: int, pressing: Pressing) -> FloatArray:
    return rotated_loads(pressing.chip_loads, study.azimuth_deg(k))


def _results(study: PreparedFingertip, model: FingertipModel, run: _Computed, counts: tuple[int, int]) -> FingertipResults:
    trained, before = counts[0], sum(counts)
    mesh = study.chip.settings.mesh
    chain = ReadingChain.of_chip(
        study.chip.design, study.chip.readout, ChipResolution(mesh.along, mesh.across, mesh.through, mesh.below, mesh.frame)
    )
    decoder = detector = None
    if study.training is not None:
        decoder = train_decoder(study.fingertip, chain, study.training, run.done[:trained])
        detector = train_slip_detector(decoder, chain, study.training, run.done[:trained], run.done[trained:before])
    pressings = tuple(run.done[before:])
    loads = tuple(_loads(study, k, p) for k, p in enumerate(pressings))
    times, recorded = _recorded(study, chain, pressings[-1], loads[-1])
    names = tuple(study.named(k) for k in range(len(pressings)))
    azimuths = tuple(study.azimuth_deg(k) for k in range(len(pressings)))
    return FingertipResults(
        model, chain, names, azimuths, pressings, loads, decoder, detector, study.settings.readings.filter_share, times, recorded
    )


def _recorded(study: PreparedFingertip, chain: ReadingChain, pressing: Pressing, loads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times (t,), s, and filtered readings (t, 3), V, of a press at the speed of its rod, as the converter gives them."""
    rate, speed = chain.readout.sample_rate_hz, study.settings.press[-1].speed_mm_min / 60.0
    way = pressing.depth_mm + np.abs(pressing.slide_mm)
    begun = round(_FREE_S * rate)
    moving = np.arange(0.0, way[-1] / speed, max(1.0 / rate, way[-1] / speed / 50_000))
    along = np.stack([np.interp(moving * speed, way, column) for column in loads.T], axis=1)
    all_loads = np.concatenate([np.zeros((begun, 6)), along, np.zeros((begun, 6))])
    rng = np.random.default_rng(study.settings.readings.seed)
    volts = first_order_filter(chain.converted(all_loads, rng), study.settings.readings.filter_share)
    return np.arange(len(volts)) * (moving[1] - moving[0]), volts


def _written(study: PreparedFingertip, results: FingertipResults, folder: Path) -> tuple[Path, ...]:
    settings: dict[str, Cell] = {"study": study.source, "sha256": study.digest, "nodes": results.model.mesh.n_points}
    chapter = Chapter(study.name, study.title, fingertip_sections(study, results), settings, fingertip_cards(results))
    page, numbers = write_chapter(chapter, folder)
    rows = [f"{t:.6g},{v[0]:.6g},{v[1]:.6g},{v[2]:.6g}" for t, v in zip(results.times_s, results.recorded_volts, strict=True)]
    head = f"# {study.named(len(study.presses) - 1)}: readings with noise, filtered\ntime_s,F_z_V,M_x_V,M_y_V"
    readings = write_atomically(folder / f"{study.name}-readings.csv", "\n".join([head, *rows]) + "\n")
    series = folder / f"{study.name}.vtkhdf"
    last = results.pressings[-1]
    turn = _turn(results.azimuths_deg[-1])
    way = last.depth_mm + np.abs(last.slide_mm)
    mesh = results.model.mesh
    solid = Mesh(mesh.points @ turn.T, mesh.cells, mesh.cell_type, mesh.regions, mesh.region_names)
    times = way / (study.settings.press[-1].speed_mm_min / 60.0)
    write_vtkhdf_series(series, solid, times, {"displacement_mm": last.displacement_mm @ turn.T})
    files = [page, numbers, series, readings]
    if results.detector is not None:
        files.append(_write_decoder(folder / f"{study.name}-decoder.json", study, results.detector))
    return tuple(files)


def _turn(azimuth_deg: float) -> FloatArray:
    c, s = np.cos(np.deg2rad(azimuth_deg)), np.sin(np.deg2rad(azimuth_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _write_decoder(path: Path, study: PreparedFingertip, detector: SlipDetector) -> Path:
    decoder = detector.decoder
    arrays = ("volts_per_load", "noise", "coefficients", "unit", "spread", "limits")
    stored = {
        "kind": DECODER,
        "naibu": __version__,
        "study": f"{study.source}, SHA-256 {study.digest}",
        "radius_mm": decoder.radius_mm,
        **{name: getattr(decoder, name).tolist() for name in arrays},
        "model_error": decoder.model_error,
        "slip": {
            "coefficients": detector.coefficients.tolist(),
            "spread": detector.spread,
            "sensitivity_mm": detector.sensitivity_mm,
            "sensitivity_error": detector.sensitivity_error,
        },
    }
    return write_atomically(path, json.dumps(stored, indent=1) + "\n")
