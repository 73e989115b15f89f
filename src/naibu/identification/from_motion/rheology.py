"""Identification of the three-element (Jeffreys) model from displacement histories of points, with or without measured forces.

The model of every region is fitted to the measured motion by Gauss-Newton on the logarithms of E, C1 and C2 and on the Poisson's ratios
(FEMU in time, :cite:p:`avril2008`). Without a force sensor displacements determine only ratios of moduli and viscosities, unless weight,
inertia, a known region or a force sets the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.parameters import Parameter, ParameterSet, Scale
from naibu.core.progress import Progress, report_progress
from naibu.identification.load_case import require_load_cases
from naibu.mechanics.small_strain.dynamics import Load, Series, simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import CellRheology, Rheology, per_region, three_element
from naibu.mechanics.small_strain.sensitivities import MaterialChange, SeriesDerivatives, simulate_motion_with_derivatives
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.point_location import interpolation_operator

KINDS = ("young_modulus", "voigt_viscosity", "series_viscosity", "poisson_ratio")
UNITS = {"young_modulus": "kPa", "voigt_viscosity": "kPa s", "series_viscosity": "kPa s", "poisson_ratio": ""}
PRIOR_SD = {"young_modulus": 3.0, "voigt_viscosity": 3.0, "series_viscosity": 3.0, "poisson_ratio": 1.5}
DIFFERENCE = 1e-4  # on the optimiser's scale, between the tables of materials that give the direction of a parameter
DETERMINED = 0.5  # a direction is determined where the data narrow its prior to less than this fraction


@dataclass(frozen=True, slots=True, eq=False)
class MotionLoadCase:
    """One load case with a measured motion.

    Attributes
    ----------
    name : str
        For messages.
    mesh : Mesh
        Lines, triangles or tetrahedra, with named regions.
    body : LinearBody
        The same, prepared.
    supports : tuple of Support
        Constraints and prescribed motions of the body.
    times_s : ndarray, shape (k,)
        Times of the measurements; the body is at rest in its reference configuration at the first.
    points_mm : ndarray, shape (q, d)
        Measured points in the reference configuration.
    displacement : ndarray, shape (k, q, d)
        mm; NaN where not measured.
    sd_mm : float
        Standard deviation of a component, mm.
    density : float or None
        kg/mm^3; None leaves inertia out.
    load : ndarray, shape (n, d), callable or None
        Known forces on the nodes, mN: weight, or a measured push.
    force : mapping of str to ndarray, shape (k, d)
        Measured force of a support on the body, mN, by the support's name; NaN where not measured.
    force_sd_mn : float
        Standard deviation of a component of the force, mN.
    step_s : float or None
        Longest time step, s; by default the spacing of `times_s`.
    """

    name: str
    mesh: Mesh
    body: LinearBody
    supports: tuple[Support, ...]
    times_s: FloatArray
    points_mm: FloatArray
    displacement: FloatArray
    sd_mm: float
    density: float | None = None
    load: FloatArray | Load | None = None
    force: Mapping[str, FloatArray] = field(default_factory=dict)
    force_sd_mn: float = np.nan
    step_s: float | None = None

    @classmethod
    def of(
        cls,
        name: str,
        mesh: Mesh,
        supports: Sequence[Support],
        times_s: ArrayLike,
        points_mm: ArrayLike,
        displacement: ArrayLike,
        *,
        sd_mm: float,
        thickness_mm: float = 1.0,
        density: float | None = None,
        load: ArrayLike | Load | None = None,
        force: Mapping[str, ArrayLike] | None = None,
        force_sd_mn: float = np.nan,
        step_s: float | None = None,
    ) -> MotionLoadCase:
        """Check and make a load case; `thickness_mm` is that of a body of triangles.

        Raises
        ------
        InputError
            Shapes that do not fit, no measurement, a standard deviation that is not positive, a force without one or of no support.
        """
        times, points, u = (np.array(a, dtype=float) for a in (times_s, points_mm, displacement))
        if points.ndim != 2 or u.shape != (len(times), *points.shape):
            raise InputError(
                f"load case {name!r}: displacement must have shape {(len(times), *points.shape)} (times, points, axes), not {u.shape}"
            )
        if not np.isfinite(u[1:]).any():
            raise InputError(f"load case {name!r}: no displacement is measured after the first time")
        if not sd_mm > 0.0:
            raise InputError(f"load case {name!r}: sd_mm must be positive, not {sd_mm:g}")
        forces = {key: np.array(value, dtype=float) for key, value in (force or {}).items()}
        for key, value in forces.items():
            if key not in {s.name for s in supports}:
                raise InputError(
                    f"load case {name!r}: force of {key!r}, but the supports are {', '.join(s.name for s in supports) or 'none'}"
                )
            if value.shape != (len(times), points.shape[1]):
                raise InputError(f"load case {name!r}: force of {key!r} must have shape {(len(times), points.shape[1])}, not {value.shape}")
        if forces and not force_sd_mn > 0.0:
            raise InputError(f"load case {name!r}: give force_sd_mn, the standard deviation of the measured force, mN")
        given = load if load is None or callable(load) else np.array(load, dtype=float)
        body = LinearBody.of(mesh, thickness_mm=thickness_mm)
        return cls(name, mesh, body, tuple(supports), times, points, u, sd_mm, density, given, forces, force_sd_mn, step_s)

    @property
    def n_data(self) -> int:
        """Number of measured components of displacements and forces."""
        return sum(int(np.isfinite(values[1:]).sum()) for values in (self.displacement, *self.force.values()))

    def simulated(self, materials: CellRheology) -> Series:
        """Return the motion with these materials."""
        return simulate_motion(self.body, materials, self.density, self.supports, self.times_s, step=self.step_s, load=self.load)

    def differentiated(self, materials: CellRheology, directions: Sequence[MaterialChange]) -> SeriesDerivatives:
        """Return the derivatives of the motion along changes of the materials."""
        given = self.body, materials, self.density, self.supports, self.times_s
        return simulate_motion_with_derivatives(*given, directions, step=self.step_s, load=self.load)[1]

    def compared(self, displacement: FloatArray, forces: Mapping[str, FloatArray]) -> FloatArray:
        """Return computed displacements (k, q, d) and forces in units of the noise, in one row, where there is a measurement."""
        parts = [(displacement / self.sd_mm)[1:][np.isfinite(self.displacement[1:])]]
        parts += [(forces[name] / self.force_sd_mn)[1:][np.isfinite(force[1:])] for name, force in self.force.items()]
        return np.concatenate(parts)


@dataclass(frozen=True, slots=True, eq=False)
class MotionEstimate:
    """Parameters identified from motions.

    Attributes
    ----------
    parameters : ParameterSet
        With the estimated values; names are ``REGION: young_modulus`` and so on.
    covariance : ndarray, shape (p, p)
        Of the free parameters on the optimiser's scale, priors included, enlarged where the misfit exceeds the noise.
    information : ndarray, shape (p, p)
        Fisher information of the data alone.
    noise_factor : float
        Root mean square residual in units of the stated noise.
    residual : tuple of ndarray, shape (k, q, d)
        Measured minus modelled displacement of every load case, mm.
    series : tuple of Series
        The modelled motions.
    undetermined : tuple of str
        Combinations of parameters that the data do not determine, in words.
    """

    parameters: ParameterSet
    covariance: FloatArray
    information: FloatArray
    noise_factor: float
    residual: tuple[FloatArray, ...]
    series: tuple[Series, ...]
    undetermined: tuple[str, ...]

    def interval(self, name: str) -> tuple[float, float]:
        """Return the 95 % interval of a free parameter."""
        names = [p.name for p in self.parameters.free]
        p = self.parameters.free[names.index(name)]
        half = 1.96 * float(np.sqrt(self.covariance[names.index(name), names.index(name)]))
        ends = sorted((p.physical(p.inner(p.value) - half), p.physical(p.inner(p.value) + half)))
        return ends[0], ends[1]


def rheology_parameters(
    start: Mapping[str, Rheology], *, known: Sequence[str] = (), purely: Mapping[str, str] | None = None
) -> ParameterSet:
    """Return the parameters of regions with their starting values and wide priors around them.

    Parameters
    ----------
    start : mapping of str to Rheology
        Rough guess for every region.
    known : sequence of str
        Parameters, ``"REGION: KIND"``, or whole regions, that are given.
    purely : mapping of str to str, optional
        Regions that are ``"elastic"``, ``"voigt"`` or ``"maxwell"`` instead of three-element.

    Raises
    ------
    InputError
        A known name that does not exist, or a model that does not.
    """
    out = []
    for region, guess in start.items():
        model = (purely or {}).get(region, "three_element")
        kinds = {"elastic": "03", "voigt": "013", "maxwell": "023", "three_element": "0123"}.get(model)
        if kinds is None:
            raise InputError(f"region {region!r}: there is no model {model!r}; use elastic, voigt, maxwell or three_element")
        for kind in (KINDS[int(k)] for k in kinds):
            name = f"{region}: {kind}"
            scale: Scale = "incompressibility" if kind == "poisson_ratio" else "log"
            out.append(
                Parameter(name, getattr(guess, kind), UNITS[kind], scale, prior_sd=PRIOR_SD[kind], fixed=name in known or region in known)
            )
    names = {p.name for p in out} | set(start)
    for name in known:
        if name not in names:
            raise InputError(f"known parameter {name!r} does not exist; there are {', '.join(p.name for p in out)}")
    return ParameterSet.of(out)


def identify_motion(load_cases: Sequence[MotionLoadCase], parameters: ParameterSet, *, progress: Progress | None = None) -> MotionEstimate:
    """Fit the parameters of all regions to the measured motions.

    Parameters
    ----------
    load_cases : sequence of MotionLoadCase
        Of bodies made of the same regions.
    parameters : ParameterSet
        From `rheology_parameters`.
    progress : callable, optional
        Gets a report after every evaluation (`naibu.core.progress`).

    Raises
    ------
    InputError
        No load case, nothing to find, or a region without parameters.
    ConvergenceError
        A motion cannot be computed.
    """
    require_load_cases(load_cases)
    if not parameters.free:
        raise InputError("all parameters are known: free at least one")
    problem = _Problem(tuple(load_cases), parameters, progress)
    found = least_squares(
        problem.residuals,
        parameters.start(),
        jac=problem.jacobian,
        loss="linear",
        method="trf",
        x_scale="jac",
        ftol=1e-8,
        xtol=1e-8,
        max_nfev=60,
    )
    return problem.estimate(found.x)


class _Problem:
    """Whitened residuals of all load cases and priors as a function of the free parameters."""

    def __init__(self, load_cases: tuple[MotionLoadCase, ...], parameters: ParameterSet, progress: Progress | None) -> None:
        self.load_cases, self.parameters, self.progress = load_cases, parameters, progress
        self.operators: list[sp.csr_array] = [interpolation_operator(t.mesh, t.points_mm) for t in load_cases]
        self.centre = np.array([p.inner(p.value) for p in parameters.free])
        self.prior_sd = np.array([p.prior_sd for p in parameters.free])
        self.evaluations = 0
        for load_case in load_cases:
            for region in load_case.mesh.region_names:
                if f"{region}: young_modulus" not in parameters.values():
                    raise InputError(f"load case {load_case.name!r}: region {region!r} has no parameters; give a starting value for it")

    def materials(self, load_case: MotionLoadCase, inner: FloatArray) -> CellRheology:
        values = self.parameters.values(inner)
        return per_region(load_case.mesh, {region: _rheology(region, values) for region in load_case.mesh.region_names})

    def simulated(self, inner: FloatArray) -> list[Series]:
        return [load_case.simulated(self.materials(load_case, inner)) for load_case in self.load_cases]

    def data_residuals(self, series: Sequence[Series]) -> FloatArray:
        parts = []
        for load_case, operator, motion in zip(self.load_cases, self.operators, series, strict=True):
            modelled = np.stack([operator @ u for u in motion.displacement])
            forces = {name: motion.force(name) - force for name, force in load_case.force.items()}
            parts.append(load_case.compared(modelled - load_case.displacement, forces))
        return np.concatenate(parts)

    def residuals(self, inner: FloatArray) -> FloatArray:
        data = self.data_residuals(self.simulated(inner))
        self.evaluations += 1
        report_progress(self.progress, "fitting measured motions", done=self.evaluations, objective=float(data @ data))
        return np.concatenate([data, (inner - self.centre) / self.prior_sd])

    def jacobian(self, inner: FloatArray) -> FloatArray:
        data = np.vstack(
            [self._data_jacobian(load_case, operator, inner) for load_case, operator in zip(self.load_cases, self.operators, strict=True)]
        )
        return np.vstack([data, np.diag(1.0 / self.prior_sd)])

    def _data_jacobian(self, load_case: MotionLoadCase, operator: sp.csr_array, inner: FloatArray) -> FloatArray:
        """Exact derivatives of the computed motion; only the tables of materials are differenced."""
        directions = []
        for step in DIFFERENCE * np.eye(len(inner)):
            ends = self.materials(load_case, inner - step), self.materials(load_case, inner + step)
            directions.append(MaterialChange.between(*ends, 2.0 * DIFFERENCE))
        found = load_case.differentiated(self.materials(load_case, inner), directions)
        columns = []
        for k, moved in enumerate(found.displacement):
            forces = {}
            for support in load_case.supports:
                acts = (load_case.times_s > support.start_s) & (load_case.times_s <= support.end_s)
                forces[support.name] = found.force(support)[k] * acts[:, None]
            columns.append(load_case.compared(np.stack([operator @ u for u in moved]), forces))
        return np.column_stack(columns)

    def estimate(self, inner: FloatArray) -> MotionEstimate:
        series = self.simulated(inner)
        data, jacobian = self.data_residuals(series), self.jacobian(inner)[: -len(inner)]
        freedom = max(len(data) - len(inner), 1)
        factor = float(np.sqrt(data @ data / freedom))
        information = jacobian.T @ jacobian / max(factor, 1.0) ** 2
        covariance: FloatArray = np.asarray(np.linalg.inv(information + np.diag(1.0 / self.prior_sd**2)), dtype=float)
        values = self.parameters.values(inner)
        residual = tuple(
            load_case.displacement - np.stack([operator @ u for u in motion.displacement])
            for load_case, operator, motion in zip(self.load_cases, self.operators, series, strict=True)
        )
        told = self.parameters.with_values({p.name: values[p.name] for p in self.parameters.free})
        return MotionEstimate(told, covariance, information, factor, residual, tuple(series), self._undetermined(information))

    def _undetermined(self, information: FloatArray) -> tuple[str, ...]:
        """Sentences for the directions, in units of the priors, that the data hardly narrow."""
        sharpness, directions = np.linalg.eigh(information * np.outer(self.prior_sd, self.prior_sd))
        free = self.parameters.free
        names = [p.name for p in free]
        out = []
        for value, direction in zip(sharpness, directions.T, strict=True):
            if 1.0 / np.sqrt(1.0 + max(value, 0.0)) < DETERMINED:
                continue
            parts = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.3]
            listed = ", ".join(names[i] for i in sorted(parts))
            if len(parts) == 1:
                out.append(f"The data hardly determine {listed}.")
            elif len({np.sign(direction[i]) for i in parts}) == 1 and all(free[i].scale == "log" for i in parts):
                out.append(f"The data do not determine a common factor of {listed}; they determine the ratios.")
            else:
                out.append(f"The data do not determine {listed} separately: changes of some compensate changes of others.")
        return tuple(out)


def _rheology(region: str, values: Mapping[str, float]) -> Rheology:
    return three_element(
        values[f"{region}: young_modulus"],
        values.get(f"{region}: voigt_viscosity", 0.0),
        values.get(f"{region}: series_viscosity", np.inf),
        values[f"{region}: poisson_ratio"],
    )
