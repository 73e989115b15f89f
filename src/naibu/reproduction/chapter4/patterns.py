"""The eight patterns (a) to (h) of loading, calibration and evaluation of the 2008 report :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.forward_model import Capture, PushedLattice, PushMode
from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem, Index, calibrate_lattice
from naibu.identification.lattice_calibration.report_indices import ReportIndices, indices_of
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.reproduction.chapter4.lattice_figures import FinalShape, ForceWave
from naibu.validation.specimens.lattice_twin import FIRST, SECOND, Law, dough_lattice, dough_twin

START = {"K": 40.0, "C1": 30.0, "C2": 50.0}  # mN/mm and mN s/mm: the initial guess of all calibrations

Key = tuple[int, PushMode, Index]  # load case, control of the virtual dough, and fitted index


@dataclass(frozen=True, slots=True)
class Pattern:
    """One pattern: the load case and control of its evaluation, and the calibration whose parameters it uses."""

    letter: str
    pushing: int
    mode: PushMode
    calibration: Key


PATTERNS = (
    Pattern("a", 0, "displacement", (0, "displacement", "shape")),
    Pattern("b", 0, "displacement", (0, "displacement", "force")),
    Pattern("c", 0, "force", (0, "force", "shape")),
    Pattern("d", 0, "force", (0, "force", "force")),
    Pattern("e", 1, "displacement", (1, "displacement", "shape")),
    Pattern("f", 1, "force", (1, "force", "force")),
    Pattern("g", 1, "displacement", (0, "displacement", "shape")),
    Pattern("h", 1, "force", (0, "force", "force")),
)
JOINT = (
    Pattern("joint 1", 0, "displacement", (0, "displacement", "joint")),
    Pattern("joint 2", 1, "displacement", (1, "displacement", "joint")),
    Pattern("joint 1 on 2", 1, "displacement", (0, "displacement", "joint")),
)
SEPARATE = (  # the report's two sets under displacement control, on either load case
    Pattern("force 1", 0, "displacement", (0, "displacement", "force")),
    Pattern("force 2", 1, "displacement", (1, "displacement", "force")),
    Pattern("force 1 on 2", 1, "displacement", (0, "displacement", "force")),
)
EVERY = (*PATTERNS, *JOINT, *SEPARATE)
ONE_SET = (PATTERNS[0], PATTERNS[6], JOINT[0], JOINT[2], SEPARATE[0], SEPARATE[2])  # the three sets of the first load case, on either


@dataclass(frozen=True, slots=True, eq=False)
class PatternStudy:
    """All calibrations, and the indices of each pattern.

    Attributes
    ----------
    lattice : Lattice
        Lattice of the model.
    captures : tuple of Capture
        First and second load case.
    estimates : dict
        Estimates by load case, control and index.
    found : dict
        Indices of every pattern by its letter or name.
    shapes, waves : dict
        Likewise the final shapes, and the forces over time.
    """

    lattice: Lattice
    captures: tuple[Capture, ...]
    estimates: dict[Key, LatticeEstimate]
    found: dict[str, ReportIndices]
    shapes: dict[str, FinalShape] = field(default_factory=dict)
    waves: dict[str, ForceWave] = field(default_factory=dict)


def pattern_study(
    seed: int = 0,
    *,
    law: Law = "finer",
    spacing_mm: float = 10.0,
    points: int = 2800,
    patterns: Sequence[Pattern] = EVERY,
    near: Mapping[Key, LatticeEstimate] | None = None,
) -> PatternStudy:
    """Calibrate on either load case under displacement and force control, on shape, force and both, and evaluate all patterns.

    Parameters
    ----------
    seed : int
        Seed of the twin's noise.
    law : str
        Law of the twin, see `naibu.validation.specimens.lattice_twin.dough_twin`.
    spacing_mm : float
        Node spacing of the model, mm.
    points : int
        Number of captured points.
    patterns : sequence of Pattern
        Which ones.
    near : mapping, optional
        Estimates of another draw, from which the searches begin; intervals are then those of the derivatives alone.
    """
    twin = dough_twin((FIRST, SECOND), law=law, spacing_mm=spacing_mm, seed=seed, points=points)
    lattice = dough_lattice(spacing_mm)
    study = PatternStudy(lattice, twin.captures, {}, {})
    estimates = study.estimates
    for pattern in patterns:
        if pattern.calibration not in estimates:
            estimates[pattern.calibration] = calibrated(
                lattice, twin.captures, pattern.calibration, near=None if near is None else near[pattern.calibration]
            )
        capture = twin.captures[pattern.pushing]
        pushed = PushedLattice.of(lattice, capture.pushing, pattern.mode, force=capture.force)
        motion = pushed.run(estimates[pattern.calibration].parameters())
        title = f"({pattern.letter})"
        study.found[pattern.letter] = indices_of(capture, pushed, motion)
        study.shapes[pattern.letter] = FinalShape.of(title, capture, pushed, motion)
        study.waves[pattern.letter] = ForceWave.of(title, capture, pushed, motion)
    return study


def calibrated(lattice: Lattice, captures: tuple[Capture, ...], key: Key, *, near: LatticeEstimate | None = None) -> LatticeEstimate:
    """Return one calibration; forces are fitted while the indenters are at rest, as in the report.

    The search begins from an estimate that is `near`, if there is one; intervals are then not widened.
    """
    number, mode, index = key
    problem = CalibrationProblem.of(lattice, [captures[number]], index=index, mode=mode, window="keep")
    scale = lattice.spacing_mm / 10.0
    start = {name: value * scale for name, value in START.items()}
    return calibrate_lattice(problem, start, max_iterations=80, warm_start=None if near is None else near.values, widen=near is None)


def with_interval_factor(estimate: LatticeEstimate, k: int) -> str:
    """Return the text of a parameter's value, and the factor by which its 95 % interval extends up and down."""
    return f"{estimate.values[k]:.3g} (x/÷ {np.exp(1.96 * np.sqrt(estimate.covariance[k, k])):.3g})"
