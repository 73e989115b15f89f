"""Run a study by its name or from its file: lattices, chips, fingertips, layered skin, or the simulations of :cite:t:`hirai2008`."""

from __future__ import annotations

import difflib
import os
import tomllib
from dataclasses import dataclass
from pathlib import Path

from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.workflows.applications.fingertip_study import FINGERTIP, FINGERTIP_TITLE, describes_fingertip, fingertip_text
from naibu.workflows.applications.simulate_chip import CHIP, CHIP_TITLE, chip_text, describes_chip, simulate_chip
from naibu.workflows.applications.simulate_fingertip import simulate_fingertip
from naibu.workflows.applications.simulate_ischemia import ISCHEMIA, ISCHEMIA_TITLE, describes_ischemia, ischemia_text, simulate_ischemia
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.studies.indentation_study import INDENTATION, INDENTATION_TITLE, describes_indentation, indentation_text
from naibu.workflows.studies.lattice_study import NAMED, TEMPLATE, study_text
from naibu.workflows.studies.simulate_indentation import simulate_indentation
from naibu.workflows.studies.simulate_lattice import CHECKPOINT_EVERY, SimulationRun, simulate_lattice
from naibu.workflows.studies.simulate_study import SLUGS, SQUARES_TOGETHER, simulate_study
from naibu.workflows.studies.sweeps.simulate_sweep import SWEEP, describes_sweep, simulate_sweep, sweep_text


@dataclass(frozen=True, slots=True)
class NamedStudy:
    """A study that naibu brings along.

    Attributes
    ----------
    name : str
        What `simulate` takes.
    model : str
        ``"finite elements"``, ``"adaptive finite elements"``, ``"mass-spring-dashpot lattice"``, ``"sensing chip"``, ``"fingertip"`` or
        ``"layered skin"``.
    title : str
        What is simulated.
    """

    name: str
    model: str
    title: str


def named_studies() -> tuple[NamedStudy, ...]:
    """Return the studies that `simulate` knows by name."""
    elements = [(name, SLUGS.get(name, "three squares side by side")) for name in (SQUARES_TOGETHER, *SLUGS)]
    lattices = [(name, tomllib.loads(study_text(name))["title"]) for name in NAMED]
    return (
        *(NamedStudy(name, "finite elements", title) for name, title in elements),
        *(NamedStudy(name, "mass-spring-dashpot lattice", title) for name, title in lattices),
        NamedStudy(INDENTATION, "adaptive finite elements", INDENTATION_TITLE),
        NamedStudy(CHIP, "sensing chip", CHIP_TITLE),
        NamedStudy(FINGERTIP, "fingertip", FINGERTIP_TITLE),
        NamedStudy(ISCHEMIA, "layered skin", ISCHEMIA_TITLE),
    )


def example_text(study: str = "") -> str:
    """Return the file of a study as a template: of a lattice, an indentation, a sensing chip, a fingertip, layered skin, or a sweep.

    Parameters
    ----------
    study : str
        Its name; a lattice by default.

    Raises
    ------
    InputError
        There is no such study, or it has no file.
    """
    of_name = {CHIP: chip_text, FINGERTIP: fingertip_text, ISCHEMIA: ischemia_text, INDENTATION: indentation_text, SWEEP: sweep_text}
    return of_name[study]() if study in of_name else study_text(study or TEMPLATE)


def simulate(
    study: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int = CHECKPOINT_EVERY,
    device: str = "cpu",
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> SimulationRun:
    """Simulate a study, and write its motion for ParaView, an animated page and the numbers; or all runs of a sweep, and one table.

    Ctrl-C (KeyboardInterrupt) ends the run of a lattice or fingertip: the frames or presses so far are kept, and the run can be resumed.

    Parameters
    ----------
    study : str or path-like
        Name of a study (see `named_studies`), or a TOML file that describes a lattice, its indenters and their motion, an indentation, a
        sensing chip, a fingertip, layered skin, or a sweep of parameters of a lattice's study.
    out : path-like
        Folder for the files.
    resume : bool
        Whether an interrupted or killed run of a lattice, fingertip or sweep is resumed; the result is the same as without an interruption.
    overwrite : bool
        Whether results that the folder holds are replaced.
    checkpoint_every : int
        Number of frames of a lattice between checkpoints, from which a run that was killed can be resumed.
    device : str
        Where a lattice is computed: ``"cpu"``, ``"cuda"`` (an NVIDIA GPU; ``"cuda:1"`` for the second), or ``"warp-cpu"`` (the kernels of
        the GPU on the processor, for tests). Contact with friction is computed on the CPU only.
    workers, cluster
        Where the runs of a sweep are computed (`naibu.workflows.parallel.worker_count.Workers`).
    progress : callable, optional
        Called with a `ProgressReport` after every frame of a lattice, and after every study of finite elements.

    Returns
    -------
    SimulationRun
        The files, and how many frames they hold.

    Raises
    ------
    InputError
        A study that cannot be used, a folder that cannot be written to or holds results, or nothing to resume.
    ConvergenceError
        An explicit method became unstable; the frames before are kept.
    """
    name = os.fspath(study)
    sweep = describes_sweep(study)
    of_chip, of_skin, of_finger = describes_chip(study), describes_ischemia(study), describes_fingertip(study)
    pressed = describes_indentation(study)
    of_elements = of_chip or of_skin or of_finger or pressed or name == SQUARES_TOGETHER or name in SLUGS
    if (sweep or of_elements) and checkpoint_every != CHECKPOINT_EVERY:
        raise InputError(
            f"checkpoint_every is {checkpoint_every}: frames between checkpoints are of lattices, and {name} is none; leave it out"
        )
    if sweep:
        if device != "cpu":
            raise InputError(f"device is {device!r}, and {name} is a sweep, whose runs are computed on 'cpu'; choose that")
        return simulate_sweep(study, out, resume=resume, overwrite=overwrite, workers=workers, cluster=cluster, progress=progress)
    if Workers(workers, cluster).elsewhere:
        raise InputError(f"`workers` and `cluster` share out the runs of a sweep, and {name} is one run; leave them out")
    if not of_elements:
        _require_study(name)
        return simulate_lattice(
            study, out, resume=resume, overwrite=overwrite, checkpoint_every=checkpoint_every, device=device, progress=progress
        )
    if resume and not of_finger:
        raise InputError(f"{name} takes seconds and keeps nothing to resume from; run it without `resume`")
    if device != "cpu":
        raise InputError(f"device is {device!r}, and {name} is a study of finite elements, which run on 'cpu'; choose that, or a lattice")
    if of_finger:
        return simulate_fingertip(study, out, resume=resume, overwrite=overwrite, progress=progress)
    if pressed:
        return SimulationRun(simulate_indentation(study, out, overwrite=overwrite, progress=progress), 1, 1)
    if of_chip:
        return SimulationRun(simulate_chip(study, out, overwrite=overwrite, progress=progress), 1, 1)
    if of_skin:
        return SimulationRun(simulate_ischemia(study, out, overwrite=overwrite, progress=progress), 1, 1)
    files = simulate_study(name, out, overwrite=overwrite, progress=progress)
    count = sum(path.suffix == ".vtkhdf" for path in files)
    return SimulationRun(tuple(files), count, count)


def _require_study(name: str) -> None:
    """Refuse a name that is neither of a study nor of something on the disk, which is told when it is read."""
    known = [study.name for study in named_studies()]
    if name in known or Path(name).exists():
        return
    near = difflib.get_close_matches(name, known, n=1)
    others = ", ".join(one for one in known if "-octree-" not in one)
    raise InputError(
        f"there is no study or file {name!r}; "
        + (f"did you mean {near[0]!r}? Else " if near else "")
        + f"give a file STUDY.toml, or one of {others}"
    )
