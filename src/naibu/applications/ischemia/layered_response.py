"""Response of layered viscoelastic skin to a load on its surface: exact in time, and in the frequency domain.

Without inertia, the Laplace transform of the motion of two layers solves ``(E1(s) K1 + E2(s) K2) u = f`` (the correspondence principle,
:cite:t:`christensen1982`), with the stiffnesses K of the layers for a unit modulus and the transforms ``E(s)`` of their three elements. In
the eigenvectors of ``(K1, K1 + K2)`` this is one equation for each mode, a ratio of polynomials in s, whose response to a step of the load
is a sum of exponentials and a linear flow.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import ArrayLike

from naibu.applications.ischemia.skin import MeshedPatch, SurfaceLoad
from naibu.core.arrays import ComplexArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.small_strain.rheology import Rheology

PARTS = 8  # of a cell of the surface, for areas
LARGEST = 6000  # unknowns whose eigenvectors are computed


def laplace_modulus(material: Rheology) -> tuple[FloatArray, FloatArray]:
    """Return numerator and denominator, polynomials in s by rising powers (3,), of the transform ``E(s)``, kPa.

    A Voigt solid (E, C1) in series with a dashpot C2: ``E(s) = (E + C1 s) C2 s / (E + (C1 + C2) s)``; ``E + C1 s`` without flow.
    """
    e, c1, c2 = material.young_modulus, material.voigt_viscosity, material.series_viscosity
    if np.isposinf(c2):
        return np.array([e, c1, 0.0]), np.array([1.0, 0.0, 0.0])
    return np.array([0.0, c2 * e, c2 * c1]), np.array([e, c1 + c2, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class LayeredModes:
    """Eigenvectors of the pair of stiffnesses of two layers, and what they contribute.

    Attributes
    ----------
    meshed : MeshedPatch
        The patch.
    share : ndarray, shape (k,)
        Share of the lower layer in the unit stiffness of every mode; 1 where there is one layer.
    vectors : ndarray, shape (n d, k)
        Displacement of every mode, 1/mm^(1/2) of unit stiffness.
    amplitude : ndarray, shape (k,)
        Modal load of 1 mN.
    """

    meshed: MeshedPatch
    share: FloatArray
    vectors: FloatArray
    amplitude: FloatArray

    @classmethod
    def of(cls, meshed: MeshedPatch) -> LayeredModes:
        """Compute the modes.

        Raises
        ------
        InputError
            A grid with too many unknowns.
        """
        free = np.flatnonzero(~meshed.constrained.ravel())
        if len(free) > LARGEST:
            raise InputError(f"the grid has {len(free)} unknowns, the modes of at most {LARGEST} are computed: use fewer cells")
        matrices = [meshed.grid.stiffness(*meshed.unit_stiffness(i))[free][:, free].toarray() for i in range(len(meshed.patch.layers))]
        load = meshed.load.ravel()[free]
        vectors = np.zeros((meshed.constrained.size, len(free)))
        share, modes = la.eigh(matrices[0], sum(matrices[1:], matrices[0]))
        vectors[free] = modes
        return cls(meshed, np.clip(share, 0.0, 1.0), vectors, load @ modes)

    def step_response(self, materials: tuple[Rheology, ...], times: ArrayLike, *, stress_in: int | None = None) -> FloatArray:
        """Return the factor of every mode (k, t) at times after a step of the load, 1/kPa.

        Parameters
        ----------
        materials : tuple of Rheology
            Of the layers, from the base upwards.
        times : array_like, shape (t,)
            s; zero before the step.
        stress_in : int, optional
            The layer whose relaxation is applied: the factor of a stress per unit modulus, without a unit.
        """
        lower, upper = laplace_modulus(materials[0]), laplace_modulus(materials[-1])
        numerator = np.convolve(lower[1], upper[1])
        if stress_in is not None:
            numerator = np.convolve(lower[0], upper[1]) if stress_in == 0 else np.convolve(upper[0], lower[1])
        a = self.share[:, None]
        denominator = a * np.convolve(lower[0], upper[1]) + (1.0 - a) * np.convolve(upper[0], lower[1])
        return _step_responses(numerator, denominator, np.asarray(times, dtype=float))


def _step_responses(numerator: FloatArray, denominator: FloatArray, times: FloatArray) -> FloatArray:
    """Return the inverse transform (k, t) of ``N(s) / (s D(s))`` for polynomials by rising powers, N (p,) and D (k, p).

    The denominator has real roots that are not positive (a chain of springs and dashpots), zero at most once.
    """
    small = 1e-14 * np.abs(denominator).max(axis=1, keepdims=True)
    given = np.where(np.abs(denominator) <= small, 0.0, denominator)
    flows = given[:, 0] == 0.0
    degree = given.shape[1] - 1 - np.argmax(given[:, ::-1] != 0.0, axis=1)
    after = np.maximum(times, 0.0)
    found = np.empty((len(given), len(times)))
    for flow, last in set(zip(flows.tolist(), degree.tolist(), strict=True)):
        alike = np.flatnonzero((flows == flow) & (degree == last))
        found[alike] = _responses_of_one_kind(numerator, given[alike, int(flow) : last + 1], flow, after)
    return np.where(times <= 0.0, 0.0, found)  # at a jump the value before it: the load still acts when it is removed


def _responses_of_one_kind(numerator: FloatArray, d: FloatArray, flow: bool, times: FloatArray) -> FloatArray:
    """Return the responses (k, t) for denominators ``D`` (without a flow) or ``s D`` (with one), D (k, p) by rising powers."""
    k, degree = len(d), d.shape[1] - 1
    at_zero = numerator[0] / d[:, :1]
    found = np.broadcast_to(at_zero, (k, len(times))).copy()
    if flow:  # N / (s^2 D): a linear flow and a constant
        slope = d[:, 1:2] if degree else np.zeros((k, 1))
        found = at_zero * times + (numerator[1] - at_zero * slope) / d[:, :1]
    if degree == 0:
        return found
    companion = np.zeros((k, degree, degree))
    companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[:, :, -1] = -d[:, :-1] / d[:, -1:]
    poles = np.linalg.eigvals(companion).real
    derivative = np.arange(1, degree + 1) * d[:, 1:]
    steepness = sum(derivative[:, i : i + 1] * poles**i for i in range(degree))
    residues = np.polyval(numerator[::-1], poles) / (poles ** (2 if flow else 1) * steepness)
    return np.asarray(found + np.einsum("kp,kpt->kt", residues, np.exp(poles[:, :, None] * times)))


@dataclass(frozen=True, slots=True, eq=False)
class SkinMotion:
    """Motion of a patch under a load that is applied at time zero, and removed.

    Attributes
    ----------
    times : ndarray, shape (t,)
        s.
    indentation : ndarray, shape (t,)
        Downward displacement of the node in the middle of the surface, mm.
    surface_nodes : ndarray, shape (k,), int64
        Nodes of the surface.
    surface : ndarray, shape (t, k, d)
        Displacement of the surface, mm.
    pressure : ndarray, shape (t, j)
        Pressure (minus a third of the trace of the stress) below parts of the surface, kPa: in the uppermost cells, and linear between
        their centres (except in three dimensions).
    change : ndarray, shape (t, j)
        By how much the pressure changes across each of these parts, kPa; zero in three dimensions.
    areas : ndarray, shape (j,)
        Areas of these parts, from the middle or from one side to the other, mm^2.
    """

    times: FloatArray
    indentation: FloatArray
    surface_nodes: IntArray
    surface: FloatArray
    pressure: FloatArray
    change: FloatArray
    areas: FloatArray

    def pale_area(self, threshold_kpa: float) -> FloatArray:
        """Return the area (t,), mm^2, where the pressure in the tissue exceeds that of the capillaries, which are then empty."""
        if not (np.isfinite(threshold_kpa) and threshold_kpa > 0.0):
            raise InputError(f"threshold_kpa must be positive, not {threshold_kpa:g} kPa")
        # the part of each part that lies above: a pressure that is linear there crosses the threshold at most once
        beyond = (self.pressure - threshold_kpa) / np.maximum(np.abs(self.change), 1e-12 * threshold_kpa)
        return np.clip(0.5 + beyond, 0.0, 1.0) @ self.areas


def simulate_skin(modes: LayeredModes, materials: tuple[Rheology, ...], load: SurfaceLoad, times: ArrayLike) -> SkinMotion:
    """Return the motion of a patch, without inertia.

    Parameters
    ----------
    modes : LayeredModes
        Of a patch and the area of the load.
    materials : tuple of Rheology
        Of the layers, from the base upwards; Poisson's ratios are those of the patch.
    load : SurfaceLoad
        Force and duration.
    times : array_like, shape (t,)
        s.

    Raises
    ------
    InputError
        Materials that do not fit the layers, or times that are not finite.
    """
    meshed = modes.meshed
    layers = meshed.patch.layers
    instants = np.asarray(times, dtype=float)
    if len(materials) != len(layers):
        raise InputError(f"materials must be given for the {len(layers)} layers of the patch, not {len(materials)}")
    for i, (given, layer) in enumerate(zip(materials, layers, strict=True)):
        if given.poisson_ratio != layer.material.poisson_ratio:
            raise InputError(
                f"materials[{i}] has a Poisson ratio of {given.poisson_ratio:g}; the modes are those of {layer.material.poisson_ratio:g}"
            )
    if instants.ndim != 1 or len(instants) == 0 or not np.isfinite(instants).all():
        raise InputError("times must be finite numbers, s")

    def of_load(stress_in: int | None) -> FloatArray:
        loaded = modes.step_response(materials, instants, stress_in=stress_in)
        return (
            load.force_mn
            * modes.amplitude[:, None]
            * (loaded - modes.step_response(materials, instants - load.duration_s, stress_in=stress_in))
        )

    d = meshed.constrained.shape[1]
    top = np.flatnonzero(meshed.grid.points[:, -1] == meshed.grid.points[:, -1].max())
    rows = (top[:, None] * d + np.arange(d)).ravel()
    surface = (modes.vectors[rows] @ of_load(None)).T.reshape(len(instants), len(top), d)
    cells = meshed.surface_cells
    strain = meshed.grid.mean_divergence()[cells] @ modes.vectors
    last = len(layers) - 1
    lame, shear = meshed.unit_stiffness(last)
    bulk = (lame + 2.0 / 3.0 * shear)[cells]
    parts = _subdivided(meshed, -(bulk[:, None] * (strain @ of_load(last))).T)
    middle = int(np.flatnonzero(top == meshed.middle)[0])
    return SkinMotion(instants, -surface[:, middle, -1], top.astype(np.int64), surface, *parts)


def skin_displacements(modes: LayeredModes, materials: tuple[Rheology, ...], load: SurfaceLoad, times: ArrayLike) -> FloatArray:
    """Return the displacement of all nodes (t, n, d), mm; see `simulate_skin`."""
    instants = np.asarray(times, dtype=float)
    under, after = (modes.step_response(materials, instants - start) for start in (0.0, load.duration_s))
    moved = modes.vectors @ (load.force_mn * modes.amplitude[:, None] * (under - after))
    return np.asarray(moved.T.reshape(len(instants), *modes.meshed.constrained.shape))


def _subdivided(meshed: MeshedPatch, pressure: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pressure and its change (t, j) in parts of cells, linear between the cells' centres, and the areas (j,) of the parts."""
    planes, kinematics = meshed.grid.planes[0], meshed.grid.kinematics
    if kinematics == "three_dimensional":
        return pressure, np.zeros_like(pressure), meshed.surface_areas
    parts = np.concatenate([*(np.linspace(a, b, PARTS, endpoint=False) for a, b in itertools.pairwise(planes)), planes[-1:]])
    centres = 0.5 * (planes[1:] + planes[:-1])
    ends = np.stack([np.interp(parts, centres, row) for row in pressure])
    areas = np.pi * np.diff(parts**2) if kinematics == "axisymmetric" else np.diff(parts) * meshed.patch.depth_mm
    return 0.5 * (ends[:, 1:] + ends[:, :-1]), np.diff(ends, axis=1), areas


def frequency_response(
    meshed: MeshedPatch, materials: tuple[Rheology, ...], frequencies_hz: ArrayLike, *, inertia: bool = True
) -> ComplexArray:
    """Return the complex indentation in the middle (f,) for a force of 1 mN that oscillates, mm/mN.

    The equations are solved directly at every frequency, with the complex moduli of the layers.

    Parameters
    ----------
    meshed : MeshedPatch
        The patch.
    materials : tuple of Rheology
        Of the layers, from the base upwards.
    frequencies_hz : array_like, shape (f,)
        Positive.
    inertia : bool
        Whether masses are counted.

    Raises
    ------
    InputError
        A frequency that is not positive.
    """
    frequencies = np.asarray(frequencies_hz, dtype=float)
    if frequencies.ndim != 1 or not (np.isfinite(frequencies).all() and (frequencies > 0.0).all()):
        raise InputError("frequencies_hz must be positive numbers")
    grid, d = meshed.grid, meshed.constrained.shape[1]
    free = np.flatnonzero(~meshed.constrained.ravel())
    matrices = [grid.stiffness(*meshed.unit_stiffness(i))[free][:, free] for i in range(len(meshed.patch.layers))]
    density = np.array([layer.density for layer in meshed.patch.layers])[meshed.layer]
    mass = sp.diags(np.repeat(grid.lumped_mass(density), d)[free])
    load = meshed.load.ravel()[free]
    middle = int(np.flatnonzero(free == meshed.middle * d + d - 1)[0])
    found = np.empty(len(frequencies), dtype=complex)
    for i, frequency in enumerate(frequencies):
        s = 2j * np.pi * frequency
        moduli = [np.polyval(n[::-1], s) / np.polyval(q[::-1], s) for n, q in map(laplace_modulus, materials)]
        matrix = moduli[0] * matrices[0]
        for modulus, stiffness in zip(moduli[1:], matrices[1:], strict=True):
            matrix = matrix + modulus * stiffness
        if inertia:
            matrix = matrix + s * s * mass
        found[i] = -spla.spsolve(sp.csc_matrix(matrix), load)[middle]
    return found
