"""Self-test of an installation: small cases whose answers are known, from files to results, as the verbs run them."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import NaibuError
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.markers import Markers
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.io.images import write_displacement, write_volume
from naibu.io.tables.marker_tables import write_experiment_folder
from naibu.workflows.markers.identify import identify
from naibu.workflows.measurement.sense import sense
from naibu.workflows.predict import predict
from naibu.workflows.studies.simulate import simulate

GRADIENT = np.array([[-0.02, 0.03, 0.0], [0.0, 0.01, -0.02], [0.015, 0.0, -0.04]])
SHIFT_MM = np.array([1.3, -0.7, 0.9])
NOISE = 0.02  # of the standard deviation of the texture
SIDE_MM, POISSON_RATIO, SD_MM = 60.0, 0.45, 0.05  # edge of a block, and standard deviation of its markers
HEIGHTS_MM = {"pressed": 57.0, "pressed_more": 55.0}
WEIGHT_MN = 12e-3 * 9810.0
STUDY = """
[object]
size_mm = [30, 20, 20]
mass_g = 12.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 200.0
C1 = 4.0
C2 = inf
[simulation]
duration_s = 0.6
gravity_mm_per_s2 = 9810
[floor]
contact = "sticking"
"""


@dataclass(frozen=True, slots=True)
class SelfCheck:
    """One number of the self-test and what it must be.

    Attributes
    ----------
    name : str
        What was computed, and its unit.
    found : float
        The result; NaN where the case could not be computed.
    low, high : float
        Bounds within which the answer is known to lie.
    seconds : float
        Time of the case.
    trouble : str
        Why it could not be computed; empty where it could.
    """

    name: str
    found: float
    low: float
    high: float
    seconds: float
    trouble: str = ""

    @property
    def passed(self) -> bool:
        """Whether the result lies within its bounds."""
        return self.low <= self.found <= self.high


Case = Callable[[Path], list[tuple[str, float, float, float]]]


def self_test(progress: Progress | None = None) -> tuple[SelfCheck, ...]:
    """Run the cases in a temporary folder, and compare their results with what is known.

    Parameters
    ----------
    progress : callable, optional
        Called before every case.

    Returns
    -------
    tuple of SelfCheck
        One for each number.
    """
    checks: list[SelfCheck] = []
    cases: dict[str, Case] = {"sense": _sense, "identify and predict": _identify, "simulate": _simulate}
    with tempfile.TemporaryDirectory(prefix="naibu-self-test-") as folder:
        for k, (name, case) in enumerate(cases.items()):
            report_progress(progress, name, done=k, total=len(cases))
            began = time.monotonic()
            try:
                found = case(Path(folder))
            except NaibuError as error:
                checks.append(SelfCheck(name, np.nan, 0.0, 0.0, time.monotonic() - began, str(error)))
                continue
            seconds = time.monotonic() - began
            checks += [SelfCheck(f"{name}: {what}", value, low, high, seconds) for what, value, low, high in found]
    return tuple(checks)


def _sense(folder: Path) -> list[tuple[str, float, float, float]]:
    """A texture of waves under a known affine motion; both scans are evaluated exactly, nothing is interpolated."""
    rng = np.random.default_rng(0)
    grid = Volume.from_array(np.zeros((28, 32, 36)), spacing_mm=(1.0, 1.0, 1.0))
    x = grid.positions()
    middle = x.reshape(-1, 3).mean(axis=0)
    truth = SHIFT_MM + (x - middle) @ GRADIENT.T
    # the material now at y came from middle + (1 + G)^-1 (y - middle - shift)
    origin = middle + (x - middle - SHIFT_MM) @ np.linalg.inv(np.eye(3) + GRADIENT).T
    texture = _texture(rng)
    for name, places in (("reference", x), ("deformed", origin)):
        noisy = texture(places) + NOISE * rng.standard_normal(grid.shape)
        write_volume(folder / f"{name}.mha", grid.with_values(noisy.astype(np.float32)))
    write_displacement(folder / "truth.mha", truth, grid)
    write_volume(folder / "mask.mha", grid.with_values(np.ones(grid.shape, dtype=np.uint8)))
    run = sense(
        folder / "reference.mha", folder / "deformed.mha", truth=folder / "truth.mha", mask=folder / "mask.mha", out=folder / "sensed"
    )
    field = run.measured.displacement
    inner = np.zeros(grid.shape, dtype=bool)
    inner[5:-5, 5:-5, 5:-5] = True
    inner &= field.valid & run.measured.mask
    error = np.linalg.norm(field.vectors - truth, axis=-1)[inner]
    sd = field.largest_sd_mm
    stated = np.nan if sd is None else float(np.mean(error < 3.0 * sd[inner]))
    return [
        ("mean error of a known displacement, mm", float(error.mean()), 0.0, 0.1),
        ("fraction measured of what both scans show", float(inner[5:-5, 5:-5, 5:-5].mean()), 0.9, 1.0),
        ("fraction of errors within 3 stated standard deviations", stated, 0.9, 1.0),
    ]


def _texture(rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Return intensities at positions (..., 3): waves of random directions, of standard deviation 1."""
    count = 60
    direction = rng.standard_normal((count, 3))
    waves = direction / np.linalg.norm(direction, axis=1)[:, None] * (2.0 * np.pi / rng.uniform(5.0, 16.0, count))[:, None]
    phases = rng.uniform(0.0, 2.0 * np.pi, count)

    def intensity(x: FloatArray) -> FloatArray:
        total = np.zeros(x.shape[:-1])
        for wave, phase in zip(waves, phases, strict=True):
            total += np.cos(x @ wave + phase)
        return np.asarray(total * np.sqrt(2.0 / count))

    return intensity


def _identify(folder: Path) -> list[tuple[str, float, float, float]]:
    """A block between smooth plates: it is compressed uniformly, and widens by its Poisson's ratio times the compression."""
    rng = np.random.default_rng(1)
    inside = np.arange(10.0, SIDE_MM, 10.0)
    x = np.stack(np.meshgrid(inside, inside, inside, indexing="ij"), axis=-1).reshape(-1, 3)
    middle = np.array([SIDE_MM / 2.0, SIDE_MM / 2.0, 0.0])
    states = {}
    for name, height in HEIGHTS_MM.items():
        strain = height / SIDE_MM - 1.0
        wider = (1.0 + strain) ** -POISSON_RATIO - 1.0
        states[name] = Markers.from_arrays(
            np.arange(len(x)), x + (x - middle) * [wider, wider, strain] + SD_MM * rng.standard_normal(x.shape)
        )
    step = SD_MM * np.sqrt(12.0)  # resolution whose rounding has this standard deviation
    write_experiment_folder(
        folder / "block", Markers.from_arrays(np.arange(len(x)), x + SD_MM * rng.standard_normal(x.shape)), states, title="Smooth plates",
        shape=Shape("box", (SIDE_MM,) * 3), loading=Loading("plate"), layers=(Layer("gel", 0.0, SIDE_MM),), stated_mm=HEIGHTS_MM,
        spacing_mm=10.0, xy_step_mm=step, z_step_mm=step,
    )  # fmt: skip
    coarse = ModelSettings(element_size_mm=20.0)
    found = identify(folder / "block", states={"block": ["pressed"]}, settings=coarse, out=folder / "identified")
    predict(folder / "identified", folder / "block", state="pressed_more", out=folder / "predicted")
    summary = json.loads((folder / "predicted" / "summary.json").read_text(encoding="utf-8"))
    ratio = found.model.parameters.values()["gel: poisson_ratio"]
    return [
        ("error of Poisson's ratio", abs(ratio - POISSON_RATIO), 0.0, 0.02),
        ("residuals over the noise", found.model.noise_factor, 0.0, 1.4),
        ("RMS of the prediction of another load, mm", summary["rms_3d_mm"], 0.0, 0.3),
    ]


def _simulate(folder: Path) -> list[tuple[str, float, float, float]]:
    """A block that stands on the floor, after it has come to rest: the floor carries its weight."""
    study = folder / "weight.toml"
    study.write_text(STUDY, encoding="utf-8")
    simulate(study, out=folder / "simulated")
    told = json.loads((folder / "simulated" / "weight.json").read_text(encoding="utf-8"))
    carried = told["forces_mN"]["floor"][-1][2]
    return [("force of the floor over the weight of a block at rest", carried / WEIGHT_MN, 0.995, 1.005)]
