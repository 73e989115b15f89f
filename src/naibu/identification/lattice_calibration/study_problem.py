"""Inverse problem of a study: captured points and recorded forces against simulated shapes and forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.forward_model import Reproduced
from naibu.identification.lattice_calibration.shape_distance import checked_points, closest_points
from naibu.identification.lattice_calibration.study_model import StudyModel
from naibu.identification.lattice_calibration.study_unknowns import StudyUnknowns
from naibu.mechanics.lattices.model.lattice import require_positive
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy

WINDOW_S = 0.02
ROUGHNESS = 2e-5  # of chi-squared in contact
LEAST_WITHIN = 0.02  # of the samples of a record within the study: with fewer, times are likely to have another unit
FEW, TIMES_OFF = 10, 30.0  # points that tell an extent, and by how many times it may differ from that of the object


@dataclass(frozen=True, slots=True, eq=False)
class RecordedForces:
    """Mean forces of windows.

    Attributes
    ----------
    window_steps : int
        Steps of the study in a window.
    force : ndarray, shape (windows, bodies, 3)
        mN; NaN where nothing was recorded.
    samples : ndarray, shape (windows, bodies)
        Number of samples that were averaged.
    shares : ndarray, shape (windows * window_steps, bodies)
        Of the steps in the means of their windows, by the samples that were taken in them: simulated forces are averaged alike.
    sd_mn : ndarray, shape (bodies,)
        Standard deviation of a component in one sample.
    """

    window_steps: int
    force: FloatArray
    samples: FloatArray
    shares: FloatArray
    sd_mn: FloatArray

    @classmethod
    def of(
        cls,
        study: LatticeStudy,
        records: Sequence[tuple[int, FloatArray, FloatArray]],
        *,
        sd_mn: float | None = None,
        window_s: float = WINDOW_S,
    ) -> RecordedForces:
        """Average samples over windows of time, the same for all records.

        Windows last at least `window_s` and are so long that, at the mean rate of the slowest record, each holds a sample. Windows
        without a sample do not count. No sample is interpolated.

        Parameters
        ----------
        study : LatticeStudy
            Gives steps and duration.
        records : sequence of (int, ndarray, ndarray)
            Number of a body, times (n,), s, and forces (n, 3), mN, on the object.
        sd_mn : float
            Standard deviation of a component of a sample, mN; by default estimated from second differences of neighbouring samples.
        window_s : float
            s.

        Raises
        ------
        InputError
            No sample during the study, or a standard deviation that is not positive or cannot be estimated.
        """
        if sd_mn is not None:
            require_positive(sd_mn, "force_sd_mn", "mN")
        slowest = max((float(np.median(np.diff(times))) for _, times, _ in records), default=0.0)
        each = max(1, round(window_s / study.step_s), int(np.ceil(1.0001 * slowest / study.step_s)))
        end = round(study.frames * study.frame_s / study.step_s)
        windows, bodies = end // each, len(study.bodies)
        if windows == 0:
            raise InputError(
                f"samples of the forces are {slowest:g} s apart, and the study lasts {end * study.step_s:g} s: no window holds one; "
                "is the unit of times another one, to be named in the column, as in time_ms?"
            )
        shares = np.full((windows * each, bodies), 1.0 / each)
        sums, samples, sd = np.zeros((windows, bodies, 3)), np.zeros((windows, bodies)), np.full(bodies, np.nan)
        for body, times, force in records:
            place = np.floor(times / (each * study.step_s) - 1e-9).astype(np.int64)
            inside = (times > 0.0) & (place < windows)
            if inside.mean() < LEAST_WITHIN:
                raise InputError(
                    f"the record of {study.bodies[body].name} lasts from {times[0]:g} to {times[-1]:g} s, the study from 0 to "
                    f"{end * study.step_s:g} s: {inside.sum() or 'no'} of {len(times)} samples lie within; give times from the beginning "
                    "of the motion on, their unit in the name of the column, as in time_ms, and not what was recorded long before or after"
                )
            np.add.at(sums[:, body], place[inside], force[inside])
            np.add.at(samples[:, body], place[inside], 1.0)
            count = np.bincount(np.floor(times[inside] / study.step_s - 1e-9).astype(np.int64), minlength=windows * each)
            shares[:, body] = count / np.maximum(np.repeat(samples[:, body], each), 1.0)
            sd[body] = sd_mn if sd_mn is not None else _noise(study.bodies[body].name, force)
        last = int(np.flatnonzero(samples.any(axis=1))[-1]) + 1 if records else 0
        mean = np.where(samples[:last, :, None] > 0.0, sums[:last] / np.maximum(samples[:last, :, None], 1.0), np.nan)
        return cls(each, mean, samples[:last], shares[: last * each], sd)


def _noise(name: str, force: FloatArray) -> float:
    """Return the standard deviation of samples (n, 3) from their second differences, robustly."""
    second = force[2:] - 2.0 * force[1:-1] + force[:-2]
    sd = float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)) if len(second) else 0.0
    if not sd > 0.0:
        raise InputError(f"the noise of the record of {name} cannot be told from its {len(force)} samples; give force_sd_mn")
    return sd


@dataclass(frozen=True, slots=True, eq=False)
class StudyLoadCase:
    """What was captured of a study, and the study with coarse and with fine steps.

    Attributes
    ----------
    points : tuple of ndarray, shape (k, 3)
        At every capture, mm.
    forces : RecordedForces
        Of the indenters.
    coarse, fine : StudyModel
        Forward models.
    """

    points: tuple[FloatArray, ...]
    forces: RecordedForces
    coarse: StudyModel
    fine: StudyModel


@dataclass(frozen=True, slots=True, eq=False)
class StudyProblem:
    """Inverse problem of calibrating a study.

    Attributes
    ----------
    unknowns : StudyUnknowns
        Parameters.
    load_cases : tuple of StudyLoadCase
        One.
    point_sd_mm : float
        Standard deviation of the coordinates of captured points.
    excess : tuple of float
        Factors of the noise of points and forces, for laws that do not fit to within it.
    """

    unknowns: StudyUnknowns
    load_cases: tuple[StudyLoadCase, ...]
    point_sd_mm: float
    excess: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def of(
        cls,
        unknowns: StudyUnknowns,
        captures: Sequence[tuple[float, FloatArray]],
        forces: RecordedForces,
        *,
        point_sd_mm: float,
    ) -> StudyProblem:
        """Set up the calibration of the study of the unknowns.

        Parameters
        ----------
        unknowns : StudyUnknowns
            What is sought.
        captures : sequence of (float, ndarray)
            Time, s, and captured surface points (k, 3), mm.
        forces : RecordedForces
            What the sensors recorded.
        point_sd_mm : float
            Standard deviation of a coordinate.

        Raises
        ------
        InputError
            Neither points nor forces, points far away from the object or in another unit, or what `StudyModel.of` refuses.
        """
        require_positive(point_sd_mm, "point_sd_mm", "mm")
        study = unknowns.study
        if not captures and not np.isfinite(forces.force).any():
            raise InputError("there are neither captured points nor recorded forces; give at least one of the two")
        lattice = study.lattice
        hull, reach = surface_of(lattice), float(np.linalg.norm(np.ptp(lattice.points, axis=0)))
        clouds = []
        for time, points in captures:
            cloud = checked_points(points, f"points captured at {time:g} s")
            _check_size(time, cloud, reach)
            far = np.abs(closest_points(cloud, hull, lattice.points).signed)
            if len(far) and far.max() > reach:
                raise InputError(
                    f"{int((far > reach).sum())} of {len(cloud)} points of {time:g} s lie up to {far.max():.4g} mm from the object "
                    f"(length {reach:.4g} mm): check unit (mm) and axes, or leave them out"
                )
            clouds.append(cloud)
        times, windows = [time for time, _ in captures], len(forces.force)
        coarse, fine = (StudyModel.of(study, times, windows, forces.window_steps, coarse=c, shares=forces.shares) for c in (True, False))
        return cls(unknowns, (StudyLoadCase(tuple(clouds), forces, coarse, fine),), point_sd_mm)

    @property
    def roughness(self) -> float:
        """How far chi-squared jumps as the parameters change, as a fraction of it: in contact, where points stick or slip."""
        return 0.0 if self.unknowns.study.tied else ROUGHNESS

    def shifts(self, values: FloatArray) -> FloatArray | None:
        """Return by how much logarithms (p,) change for differences, in contact; derivatives of tied studies are integrated."""
        return None if self.unknowns.study.tied else self.unknowns.shifts(values)

    def enlarged(self, excess: tuple[float, float]) -> StudyProblem:
        """Return the problem with other factors of the noise."""
        return replace(self, excess=excess)

    def weighed(
        self, load_case: StudyLoadCase, found: Reproduced, step: float
    ) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Return residuals and derivatives (count,), (count, p) of points and of forces in units of their noise."""
        p, hull = len(found.force_change), load_case.coarse.hull
        rows, slopes = [np.zeros(0)], [np.zeros((0, p))]
        for k, points in enumerate(load_case.points):
            near = closest_points(points, hull, found.positions[k])
            sd = self.point_sd_mm * self.excess[0]
            rows.append(near.signed / sd)
            corners = hull.triangles[near.triangle]
            moved = (
                (found.positions_change[:, k][:, corners] * near.weights[:, :, None]).sum(axis=2) if p else np.zeros((0, len(points), 3))
            )
            slopes.append(-(moved * near.direction).sum(axis=2).T / sd)
        return (np.concatenate(rows), np.concatenate(slopes)), self._force_rows(load_case.forces, found, p)

    def _force_rows(self, forces: RecordedForces, found: Reproduced, p: int) -> tuple[FloatArray, FloatArray]:
        counted = np.isfinite(forces.force)
        sd = self.excess[1] * forces.sd_mn / np.sqrt(np.maximum(forces.samples, 1.0))
        each = np.broadcast_to(sd[:, :, None], counted.shape)[counted]
        slopes = np.stack([change[counted] for change in found.force_change], axis=1) if p else np.zeros((int(counted.sum()), 0))
        return (found.force[counted] - forces.force[counted]) / each, slopes / each[:, None]


def _check_size(time: float, cloud: FloatArray, reach: float) -> None:
    """Refuse points whose extent says that their unit is not the one that is named: they are many, and far from as large as the object."""
    extent = float(np.linalg.norm(np.ptp(cloud, axis=0))) if len(cloud) >= FEW else reach
    if not reach / TIMES_OFF < extent < TIMES_OFF * reach:
        factor = 10.0 ** round(np.log10(reach / extent)) if extent > 0.0 else 0.0
        told = f", as if their unit were {factor:g} times the one that is named" if factor else ""
        raise InputError(
            f"the {len(cloud)} points of {time:g} s extend over {extent:.4g} mm, the object of the study over {reach:.4g} mm{told}: "
            "name the unit in the columns, as in x_m or x_mm, or correct size_mm of the study"
        )
