"""Run studies of lattices: a series for ParaView that grows during the run, numbers, an animated page, and a checkpoint to resume from."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray, require_count
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.vtkhdf_series import SeriesFile
from naibu.mechanics.lattices.model.contact_surface import unresolved
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy, StudyFrame, StudyState, run_study
from naibu.viewer.cards import Card
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, force_unit, motion_html
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_forces
from naibu.viewer.tables import Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.lattice_study import PreparedStudy, prepared_study
from naibu.workflows.studies.simulate_checkpoint import Checkpoint

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

CHECKPOINT_EVERY = 10  # frames
PAGE_BYTES = 3_000_000
PAGE_FRAMES, PAGE_POINTS = 200, 2_000_000
ARRAYS = {"displacement": "displacement_mm", "velocity": "velocity_mm_per_s", "stretch": "stretch"}


@dataclass(frozen=True, slots=True, eq=False)
class SimulationRun(ShownInNotebook):
    """The files of a simulation, and how far it came.

    Attributes
    ----------
    files : tuple of Path
        Page, series and numbers, and, where it was interrupted, the checkpoint from which it resumes.
    frames, of : int
        Number of frames kept after the first, and number asked for; of finite elements, number of studies or presses.
    parts : str
        What is counted.
    warnings : tuple of str
        What makes forces doubtful.
    """

    files: tuple[Path, ...]
    frames: int
    of: int
    parts: str = "frames"
    warnings: tuple[str, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether all frames are there."""
        return self.frames == self.of

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document.

        Raises
        ------
        InputError
            The run was stopped before it wrote a page.
        """
        return self._file(".html").read_text(encoding="utf-8")

    def plot(self) -> Canvas:
        """Return a figure of the forces on a lattice over time.

        Raises
        ------
        InputError
            The study is not one of a lattice, or has no indenters.
        """
        times, forces = self._forces()
        unit, factor = force_unit(max(float(np.abs(f).max(initial=0.0)) for f in forces.values()))
        canvas = empty_figure(7.0, 4.0)
        draw_forces(canvas, times, {name: factor * f for name, f in forces.items()}, unit)
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a time, s, and indenter: its force on the lattice along x, y, z, mN.

        Raises
        ------
        InputError
            The study is not one of a lattice, or has no indenters.
        """
        times, forces = self._forces()
        names = ("time_s", "indenter", "x_mN", "y_mN", "z_mN")
        return tuple(
            dict(zip(names, (float(t), name, *f.tolist()), strict=True))
            for name, force in forces.items()
            for t, f in zip(times, force, strict=True)
        )

    def _file(self, ending: str) -> Path:
        found = next((file for file in self.files if file.suffix == ending), None)
        if found is None:
            raise InputError(f"the run has no {ending} file; see `files` for what it wrote")
        return found

    def _forces(self) -> tuple[FloatArray, dict[str, FloatArray]]:
        numbers = json.loads(self._file(".json").read_text(encoding="utf-8"))
        if not numbers.get("forces_mN") or "force_times_s" not in numbers:
            raise InputError(f"{self._file('.json').name} has no forces of indenters on a lattice; its page shows what was computed")
        forces = {name: np.asarray(rows, dtype=np.float64).reshape(-1, 3) for name, rows in numbers["forces_mN"].items()}
        return np.asarray(numbers["force_times_s"], dtype=np.float64), forces


@no_empty_folders()
def simulate_lattice(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int = CHECKPOINT_EVERY,
    device: str = "cpu",
    progress: Progress | None = None,
) -> SimulationRun:
    """Run a study, and write ``NAME.html``, ``NAME.vtkhdf`` and ``NAME.json``; an interruption keeps the frames computed so far.

    The memory needed does not grow with the number of frames.

    Parameters
    ----------
    source : str or path-like
        Name of a study in `naibu.workflows.studies.lattice_study.NAMED`, or a file.
    out : path-like
        Folder for the files.
    resume : bool
        Whether an interrupted or killed run goes on; the result is the same as if it had not been interrupted.
    overwrite : bool
        Whether results that the folder holds are replaced.
    checkpoint_every : int
        Number of frames between checkpoints, from which a run that was killed can be resumed.
    device : str
        ``"cpu"``, ``"cuda"`` or ``"cuda:1"`` and so on (an NVIDIA GPU), or ``"warp-cpu"`` (the GPU's kernels on the processor, for tests).
    progress : callable, optional
        Called with a `ProgressReport` after every frame.

    Returns
    -------
    SimulationRun
        Of a run that Ctrl-C stopped, too; it then holds ``NAME.checkpoint.npz``.

    Raises
    ------
    InputError
        What `naibu.workflows.studies.lattice_study.prepared_study` refuses, a folder that cannot be written or holds results, or nothing
        to resume.
    ConvergenceError
        An explicit method diverged; the frames before are kept.
    """
    every = require_count("checkpoint_every", checkpoint_every)
    prepared = prepared_study(source)
    checkpoint = Checkpoint.of(Path(out), prepared)
    if resume:
        start = checkpoint.read()
    elif not overwrite and checkpoint.path.exists():
        raise InputError(
            f"{checkpoint.path}: is what an interrupted run can be resumed from; continue it with `resume`, begin anew with `overwrite`, "
            "or choose another folder as `out`"
        )
    else:
        start = None
    names = () if resume else [f"{prepared.name}.{ending}" for ending in ("html", "vtkhdf", "json")]
    before = checkpoint.needed()
    folder = output_folder(out, names, overwrite=overwrite, keep=before)
    with _series(folder, prepared, start, checkpoint) as series:
        state, stopped = _computed(prepared, series, start, checkpoint, every, device, progress)
        if state is None:
            raise stopped or KeyboardInterrupt
        series.truncate(state.frame + 1)  # what an interruption left of the next one
        try:
            files = _written(prepared, series, state, folder)
        except InputError as error:
            kept = f"The first {state.frame} frames are kept; free what is in the way and run again with `resume`"
            raise InputError(f"{error}. {kept}") from error
        finally:
            series.finish()
            checkpoint.write(state, series.target.name)
    if state.frame == prepared.study.frames:
        checkpoint.path.unlink(missing_ok=True)
    else:
        files = (*files, checkpoint.path)
    for name in before:
        (folder / name).unlink(missing_ok=True)
    if stopped is not None and not isinstance(stopped, KeyboardInterrupt):
        kept = f"The first {state.frame * prepared.study.frame_s:g} s are kept in {series.target}."
        raise type(stopped)(f"{stopped} {kept}") from stopped
    return SimulationRun(files, state.frame, prepared.study.frames, warnings=_warnings(prepared))


def _series(folder: Path, prepared: PreparedStudy, start: StudyState | None, checkpoint: Checkpoint) -> SeriesFile:
    """Begin the series, or take up what a checkpoint belongs to."""
    path = folder / f"{prepared.name}.vtkhdf"
    if start is None:
        return SeriesFile.begun(path, prepared.mesh, prepared.fingerprint)
    aside = next((folder / name for name in checkpoint.needed()[:1] if (folder / name).exists()), None)
    return SeriesFile.continued(path, prepared.mesh, start.frame + 1, prepared.fingerprint, aside)


def _computed(
    prepared: PreparedStudy,
    series: SeriesFile,
    start: StudyState | None,
    checkpoint: Checkpoint,
    every: int,
    device: str,
    progress: Progress | None,
) -> tuple[StudyState | None, BaseException | None]:
    """Append frames; return the last whole one, and what stopped the run before its end."""
    state = start
    try:
        for frame in run_study(prepared.study, start, device=device):
            _append(series, prepared, frame)
            state = frame.state
            if state.frame and (state.frame % every == 0 or state.frame == prepared.study.frames):
                checkpoint.write(state, series.checkpoint().name)
            report_progress(progress, f"simulate {prepared.name}", done=state.frame, total=prepared.study.frames)
    except (KeyboardInterrupt, ConvergenceError) as error:
        return state, error
    return state, None


def _append(series: SeriesFile, prepared: PreparedStudy, frame: StudyFrame) -> None:
    lattice, state = prepared.study.lattice, frame.state
    moved = state.lattice.position - lattice.points
    turn = lattice.frame.rotation  # to the scanner's frame, in which the points of the series are
    values = {
        "displacement": moved @ turn.T,
        "velocity": state.lattice.velocity @ turn.T,
        "stretch": mean_stretch(prepared.study, state.lattice.position),
    }
    kept = {"displacement", *prepared.settings.output.quantities}
    first = max(state.frame - 1, 0) * prepared.study.samples
    series.append_rows("force_time_s", frame.sample_times, first)
    series.append_rows("force_mN", frame.force, first)
    series.append_rows("position_mm", state.positions[None], state.frame)
    energies = [frame.kinetic, frame.spring, state.external_work, *state.work]
    series.append_rows("energy_mN_mm", np.array([energies]), state.frame)
    series.append_rows("momentum_kg_mm_per_s", frame.momentum[None], state.frame)
    series.append(frame.time, {ARRAYS[q]: v.astype(np.float32) for q, v in values.items() if q in kept})


def mean_stretch(study: LatticeStudy, position: FloatArray) -> FloatArray:
    """Return how much longer than at rest the elements at every node are on average (n,), as a fraction of their length."""
    lattice = study.lattice
    i, j = lattice.elements.T
    rest = lattice.lengths
    strain = np.linalg.norm(position[j] - position[i], axis=1) / rest - 1.0
    ends = np.concatenate([i, j])
    sums = np.bincount(ends, np.concatenate([strain, strain]), minlength=lattice.n_nodes)
    return np.asarray(sums / np.maximum(np.bincount(ends, minlength=lattice.n_nodes), 1))


def _written(prepared: PreparedStudy, series: SeriesFile, state: StudyState, folder: Path) -> tuple[Path, ...]:
    """Write numbers and page of the frames in the series."""
    numbers = _numbers(prepared, series, state)
    told = write_atomically(folder / f"{prepared.name}.json", json.dumps(numbers, indent=1) + "\n")
    page = write_atomically(folder / f"{prepared.name}.html", motion_html(_page(prepared, series, state), PAGE_BYTES))
    return page, series.target, told


def _numbers(prepared: PreparedStudy, series: SeriesFile, state: StudyState) -> dict[str, Any]:
    study, lattice = prepared.study, prepared.study.lattice
    count = state.frame * study.samples
    force, energy = series.rows("force_mN")[:count], series.rows("energy_mN_mm")[: state.frame + 1]
    names = [body.name for body in study.bodies]
    positions = series.rows("position_mm")[: state.frame + 1]
    return {
        "study": prepared.title,
        "naibu": __version__,
        "source": prepared.source,
        "finished": state.frame == study.frames,
        "settings": _plain(prepared.settings.model_dump(mode="python", exclude_none=True)),
        "inputs_sha256": prepared.inputs,
        "fingerprint": prepared.fingerprint,
        "units": "mm, kg, s, mN, mN mm",
        "warnings": list(_warnings(prepared)),
        "scanner_frame": {"direction": lattice.frame.rotation.tolist(), "origin_mm": lattice.frame.translation.tolist()},
        "nodes": study.lattice.n_nodes,
        "elements": study.lattice.n_elements,
        "mass_kg": study.lattice.total_mass,
        "steps_with_unsettled_contacts": state.unsettled,
        "times_s": series.times()[: state.frame + 1].tolist(),
        "kinetic_mN_mm": energy[:, 0].tolist(),
        "springs_mN_mm": energy[:, 1].tolist(),
        "work_of_external_force_mN_mm": energy[:, 2].tolist(),
        "work_mN_mm": {name: energy[:, 3 + k].tolist() for k, name in enumerate(names)},
        "momentum_kg_mm_per_s": series.rows("momentum_kg_mm_per_s")[: state.frame + 1].tolist(),
        "positions_mm": {name: positions[:, k].tolist() for k, name in enumerate(names)},
        "force_times_s": series.rows("force_time_s")[:count].tolist(),
        "forces_mN": {name: force[:, k].tolist() for k, name in enumerate(names)},
    }


def _plain(value: Any) -> Any:
    """Return settings as JSON knows them."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return "infinite" if isinstance(value, float) and np.isinf(value) else value


def _page(prepared: PreparedStudy, series: SeriesFile, state: StudyState) -> MotionPage:
    study = prepared.study
    triangles = surface_of(study.lattice).triangles
    nodes, faces = np.unique(triangles, return_inverse=True)
    most = max(2, min(PAGE_FRAMES, PAGE_POINTS // len(nodes)))
    frames = np.unique(np.linspace(0, state.frame, min(most, state.frame + 1)).round().astype(int))
    moved = np.stack([series.values(ARRAYS["displacement"], int(k))[nodes] for k in frames]).astype(float) @ study.lattice.frame.rotation
    fields = [ColourField("displacement, mm", np.linalg.norm(moved, axis=2))]
    if "stretch" in prepared.settings.output.quantities:
        stretch = np.stack([series.values(ARRAYS["stretch"], int(k))[nodes] for k in frames]).astype(float)
        fields.append(ColourField("mean stretch of the elements, %", 100.0 * stretch, diverging=True))
    shapes = [(b.name, b.indenter.geometry) for b in study.bodies]
    bodies = [RigidShape(name, shape.name, shape.size, shape.axes) for name, shape in shapes]
    count = state.frame * study.samples
    force = series.rows("force_mN")[:count]
    positions = series.rows("position_mm")[frames].reshape(len(frames), len(bodies), 3)
    times = series.times()[frames]
    provenance = {
        "naibu": __version__,
        "source": prepared.source,
        "SHA-256": prepared.inputs,
        "settings": _plain(prepared.settings.model_dump(mode="python", exclude_none=True)),
    }
    return MotionPage(
        prepared.title, _sentences(prepared, state, force), times, faces.reshape(-1, 3), study.lattice.points[nodes], moved, fields, bodies,
        positions, series.rows("force_time_s")[:count], force, _tables(prepared, force, moved, times), provenance,
        _cards(prepared, force, moved),
    )  # fmt: skip


def _sentences(prepared: PreparedStudy, state: StudyState, force: FloatArray) -> list[str]:
    study = prepared.study
    lattice = study.lattice
    found = [
        f"{lattice.n_nodes} nodes, {1e3 * lattice.total_mass:.4g} g in all, joined by {lattice.n_elements} elements of a spring and "
        f"two dashpots; {study.frames * study.frame_s:g} s in steps of {1e3 * study.step_s:g} ms."
    ]
    if state.frame < study.frames:
        found.append(f"The run was interrupted: this is the part until {state.frame * study.frame_s:g} s.")
    idle = [b.name for k, b in enumerate(study.bodies) if not np.abs(force[:, k]).any()]
    if idle and state.frame == study.frames:
        found.append(f"Never touched the object: {', '.join(idle)}.")
    return [*found, *_warnings(prepared)]


def _warnings(prepared: PreparedStudy) -> tuple[str, ...]:
    """Return which indenters are smaller than what the surface resolves."""
    said = (unresolved(prepared.study.lattice, b.indenter.geometry, b.name) for b in prepared.study.bodies)
    return tuple(filter(None, said))


def _cards(prepared: PreparedStudy, force: FloatArray, moved: FloatArray) -> tuple[Card, ...]:
    size = np.linalg.norm(moved, axis=2).max(axis=1)
    cards = [
        Card("Largest displacement", f"{size.max():.3g} mm", "of the surface"),
        Card("Left at the end", f"{size[-1]:.3g} mm", "largest displacement of the surface"),
    ]
    unit, factor = force_unit(float(np.abs(force).max(initial=0.0)))
    for k, body in enumerate(prepared.study.bodies[:4]):
        largest = factor * float(np.linalg.norm(force[:, k], axis=1).max(initial=0.0))
        cards.append(Card(f"Largest force of {body.name}", f"{largest:.3g} {unit}" if largest else "no contact"))
    return tuple(cards)


def _tables(prepared: PreparedStudy, force: FloatArray, moved: FloatArray, times: FloatArray) -> list[Table]:
    largest = np.linalg.norm(moved, axis=2).max(axis=1)
    rows: list[tuple[str, float | None, float | None]] = [
        ("largest displacement of the surface, mm", float(largest.max()), float(times[int(np.argmax(largest))])),
        ("largest displacement of the surface at the end, mm", float(largest[-1]), float(times[-1])),
    ]
    unit, factor = force_unit(float(np.abs(force).max(initial=0.0)))
    for k, body in enumerate(prepared.study.bodies):
        size = np.linalg.norm(force[:, k], axis=1)
        if len(size):
            at = prepared.study.sample_s * (int(np.argmax(size)) + 1)
            rows.append((f"largest force of {body.name}, {unit}", factor * float(size.max()), float(at) if size.max() > 0.0 else None))
    return [Table("Largest values", ("quantity", "value", "time, s"), tuple(rows))]
