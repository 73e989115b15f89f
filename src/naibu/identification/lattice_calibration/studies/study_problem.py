"""Inverse problem of a study: captured points and recorded forces against simulated shapes and forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.captured.sensor_errors import LITTLE_DRIFT, BodyResiduals, SensorErrors, body_residuals
from naibu.identification.lattice_calibration.captured.shape_distance import checked_points, closest_points
from naibu.identification.lattice_calibration.forward_model import Reproduced
from naibu.identification.lattice_calibration.studies.study_model import StudyModel
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.mechanics.lattices.model.lattice import require_positive
from naibu.mechanics.lattices.model.surface import surface_of

ROUGHNESS = 2e-5  # of chi-squared in contact
FEW, TIMES_OFF = 10, 30.0  # points that tell an extent, and by how many times it may differ from that of the object


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
    sensor_errors : SensorErrors
        That force sensors may have; what they explain is no residual.
    """

    unknowns: StudyUnknowns
    load_cases: tuple[StudyLoadCase, ...]
    point_sd_mm: float
    excess: tuple[float, float] = (1.0, 1.0)
    sensor_errors: SensorErrors = LITTLE_DRIFT

    @classmethod
    def of(
        cls,
        unknowns: StudyUnknowns,
        captures: Sequence[tuple[float, FloatArray]],
        forces: RecordedForces,
        *,
        point_sd_mm: float,
        sensor_errors: SensorErrors = LITTLE_DRIFT,
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
        sensor_errors : SensorErrors
            That the sensors may have, to be estimated along.

        Raises
        ------
        InputError
            Neither points nor forces, records too short for the errors of their sensors, points far away from the object or in another
            unit, or what `StudyModel.of` refuses.
        """
        require_positive(point_sd_mm, "point_sd_mm", "mm")
        study = unknowns.study
        if not captures and not np.isfinite(forces.force).any():
            raise InputError("there are neither captured points nor recorded forces; give at least one of the two")
        counts = np.isfinite(forces.force).all(axis=2).sum(axis=0)
        if (few := counts[counts > 0]).size and few.min() <= sensor_errors.unknowns + int(sensor_errors.delay):
            raise InputError(
                f"a record of forces has samples in {few.min()} windows of time only, which cannot tell errors of its sensor as well: set "
                "sensor_errors to 'none', or record more"
            )
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
        return cls(unknowns, (StudyLoadCase(tuple(clouds), forces, coarse, fine),), point_sd_mm, sensor_errors=sensor_errors)

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

    def with_half_steps(self) -> StudyProblem | None:
        """Return the problem with fine steps of half the length; None in contact, where jumps count more than what steps leave."""
        if not self.unknowns.study.tied:
            return None
        study = self.unknowns.study
        shorter = replace(study, step_s=0.5 * study.step_s, sample_steps=2 * study.sample_steps)
        cases = []
        for case in self.load_cases:
            forces, times = case.forces, [study.step_s * step for step in case.fine.captures]
            shares = 0.5 * np.repeat(forces.shares, 2, axis=0)
            fine = StudyModel.of(shorter, times, len(forces.force), 2 * forces.window_steps, coarse=False, shares=shares)
            cases.append(replace(case, fine=fine))
        return replace(self, unknowns=replace(self.unknowns, study=shorter), load_cases=tuple(cases))

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
        residual, slopes = np.zeros(counted.shape), np.zeros((p, *counted.shape))
        for body, own in self.of_bodies(forces, found).items():
            residual[own.counted, body], slopes[:, own.counted, body] = own.residual, own.slopes
        return residual[counted], slopes[:, counted].T

    def of_bodies(self, forces: RecordedForces, found: Reproduced) -> dict[int, BodyResiduals]:
        """Return the residuals of every body that has a record, with what errors of its sensor explain."""
        errors, excess = self.sensor_errors, self.excess[1]
        recorded = np.flatnonzero(np.isfinite(forces.force).any(axis=(0, 2)))
        return {
            body: body_residuals(errors, forces, body, found.force[:, body], found.force_change[:, :, body], found.history, excess)
            for body in recorded.tolist()
        }


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
