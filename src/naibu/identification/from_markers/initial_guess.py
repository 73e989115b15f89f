"""Equilibrium gap between markers, as initial guess: at an unloaded marker the forces of the cells around it sum to zero.

The principle is that of :cite:t:`claire2004` and of chapter 3 of :cite:t:`hirai2008` with a finite-strain law: one linear least-squares
problem in the moduli for all load cases, without initial guess or boundary conditions. It is sensitive to noise in the displacement, which
enters the matrix as well and biases Poisson's ratio towards its lower bound. Further sweeps therefore weight the equations with the
covariance that the noise gives them, and correct the displacement by the least amount that restores equilibrium: the Gauss-Helmert model of
least squares with conditions (:cite:p:`mikhail1976`). Nodes interpolated on an interface have equal strain on both sides, where in reality
the traction is equal: they bias unknown moduli towards the known ones. The estimate is good enough for a start: within a factor of two
under plates, and worse under a bar.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import lsq_linear

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.marker_mesh import MarkerMesh, marker_mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import from_moduli, law_named

if TYPE_CHECKING:
    from naibu.identification.from_markers.known_materials import KnownMaterials

LAW = law_named("neo_hookean")
SWEEPS = 2  # with noise the estimate has not settled then, nor after 20: beyond about 4 it varies from one noise draw to the next
UNMEASURED_SD_MM = 0.5  # of a node that was completed or interpolated
POISSON_RATIO = 0.45  # of a known material, until a sweep has found its own
SMALLEST, LARGEST = 1e-3, 1e3  # bounds of the moduli, in units of the known ones


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Equations ``matrix @ sought = right``, the lower Cholesky factor of their covariance, and the `scaled` tangent that noise passes."""

    matrix: FloatArray
    right: FloatArray
    factor: FloatArray
    scaled: FloatArray


@dataclass(slots=True, eq=False)
class _MeshEquations:
    """A marker mesh with its assembler; `displacement` is corrected by the sweeps."""

    source: MarkerMesh
    sd: FloatArray
    assembler: Assembler
    displacement: FloatArray

    @classmethod
    def of(cls, source: MarkerMesh, sd: FloatArray) -> _MeshEquations:
        placeholder = [from_moduli(LAW, 1.0, 10.0)] * len(source.mesh.region_names)
        assembler = Assembler.from_materials(elements(source.mesh), source.mesh.regions, placeholder)
        if assembler.forces(source.displacement)[2] <= 0.0:
            raise InputError(f"{source.label}: a cell between markers is inverted; check the markers' numbers and positions")
        spread = np.where(source.measured, sd, UNMEASURED_SD_MM)
        return cls(source, spread, assembler, source.displacement)

    def column(self, material: str, which: int) -> FloatArray:
        """Forces (3 k,) on the interior nodes of a unit of the shear modulus (0) or of Lame's lambda (1) of a material."""
        mesh = self.source.mesh
        if material not in mesh.region_names:
            return np.zeros(3 * len(self.source.interior))
        direction = np.zeros((mesh.n_cells, 4))
        direction[mesh.regions == mesh.region_names.index(material), which] = 1.0
        return self.assembler.forces_of_parameter(self.displacement, direction)[self.source.interior].ravel()

    def tangent(self, moduli: Mapping[str, tuple[float, float]]) -> FloatArray:
        """Derivatives (3 k, 3 n) of the forces on the interior nodes with respect to the displacement."""
        mesh = self.source.mesh
        table = np.zeros((len(mesh.region_names), 4))
        table[:, :2] = [moduli[name] for name in mesh.region_names]
        blocks = self.assembler.with_parameters(table[mesh.regions]).evaluate(self.displacement)[2]
        rows = (3 * self.source.interior[:, None] + np.arange(3)).ravel()
        return np.asarray(self.assembler.pattern.matrix(blocks).tocsr()[rows].toarray())

    def system(
        self, sought: Sequence[tuple[str, int]], fixed: Mapping[tuple[str, int], float], moduli: Mapping[str, tuple[float, float]] | None
    ) -> _System:
        """Return the equilibrium equations of this load case, linearised about `displacement`; without `moduli` all have unit weight."""
        matrix = np.column_stack([self.column(*key) for key in sought])
        right = -np.sum([value * self.column(*key) for key, value in fixed.items()], axis=0)
        if moduli is None:
            return _System(matrix, right, np.eye(len(right)), np.zeros((len(right), self.sd.size)))
        tangent = self.tangent(moduli)
        scaled = tangent * self.sd.ravel()
        factor = np.asarray(np.linalg.cholesky(scaled @ scaled.T), dtype=np.float64)
        return _System(matrix, right - tangent @ (self.source.displacement - self.displacement).ravel(), factor, scaled)


def equilibrium_gap(
    experiments: Sequence[Experiment],
    known_materials: KnownMaterials,
    states: Mapping[str, Sequence[str]] | None = None,
    *,
    poisson_ratios: Mapping[str, float] | None = None,
    noise: NoiseModel | None = None,
    sweeps: int = SWEEPS,
) -> dict[str, tuple[float, float]]:
    """Estimate the materials with unknown modulus by the equilibrium gap between markers, over all load cases jointly.

    Blocks that merely lie on each other are taken to be tied.

    Parameters
    ----------
    experiments : sequence of Experiment
        With markers numbered on a lattice.
    known_materials : KnownMaterials
        Materials with known Young's modulus, kPa; at least one.
    states : mapping, optional
        States to use, by experiment; all measured ones by default.
    poisson_ratios : mapping, optional
        Of known materials; sought too where not given.
    noise : NoiseModel, optional
        Of the measurement.
    sweeps : int
        Weighted sweeps after the first, unweighted one; 0 gives the batch method of :cite:t:`hirai2008`.

    Returns
    -------
    dict
        (Young's modulus in kPa, Poisson's ratio) of every unknown material.

    Raises
    ------
    InputError
        No known material, no lattice, no loaded state, too few nodes in the inside, or an unknown material that no known one touches.
    """
    measured, meshes, spreads = noise or NoiseModel(), [], []
    for e in experiments:
        for state in (states or {}).get(e.name, [s.name for s in e.loaded_states]):
            meshes.append(marker_mesh(e, state))
            spreads.append(np.sqrt(2.0) * measured.of_experiment(e))
    if not meshes:
        raise InputError(f"no loaded state with measured positions in {', '.join(e.name for e in experiments) or 'no experiment'}")
    return equilibrium_gap_of_meshes(meshes, spreads, known_materials.young_moduli, poisson_ratios=poisson_ratios, sweeps=sweeps)


def equilibrium_gap_of_meshes(
    meshes: Sequence[MarkerMesh],
    spreads: Sequence[FloatArray],
    young_moduli: Mapping[str, float],
    *,
    poisson_ratios: Mapping[str, float] | None = None,
    sweeps: int = SWEEPS,
) -> dict[str, tuple[float, float]]:
    """Estimate unknown materials from displaced meshes; see `equilibrium_gap`.

    Parameters
    ----------
    meshes : sequence of MarkerMesh
        One for each load case.
    spreads : sequence of ndarray, shape (3,)
        Standard deviation of a displacement along x, y, z in every load case, mm.
    young_moduli, poisson_ratios : mapping of str to float
        Known ones, kPa.
    sweeps : int
        Weighted sweeps.

    Raises
    ------
    InputError
        See `equilibrium_gap`.
    """
    names = list(dict.fromkeys(name for m in meshes for name in m.mesh.region_names))
    known = {name: e for name, e in young_moduli.items() if name in names}
    unknown = [name for name in names if name not in known]
    _require_solvable(meshes, known, unknown)
    given = {name: nu for name, nu in (poisson_ratios or {}).items() if name in known}
    sought = [(name, which) for name in unknown for which in (0, 1)] + [(name, 1) for name in known if name not in given]
    load_cases = [_MeshEquations.of(mesh, sd) for mesh, sd in zip(meshes, spreads, strict=True)]
    ratios = {name: given.get(name, POISSON_RATIO) for name in known}
    moduli: dict[str, tuple[float, float]] = {}
    for sweep in range(sweeps + 1):
        fixed = {(name, 0): e / (2.0 * (1.0 + ratios[name])) for name, e in known.items()}
        fixed |= {(name, 1): 2.0 * fixed[name, 0] * nu / (1.0 - 2.0 * nu) for name, nu in given.items()}
        found = _sweep(load_cases, sought, fixed, moduli if sweep else None)
        if found is None:
            break
        old, moduli = moduli, found
        ratios |= {name: min(_young(*moduli[name])[1], MAX_POISSON_RATIO) for name in known if name not in given}
        if old and all(np.allclose(moduli[name], old[name], rtol=1e-9) for name in names):
            break
    return {name: _young(*moduli[name]) for name in unknown}


def _sweep(
    load_cases: Sequence[_MeshEquations],
    sought: Sequence[tuple[str, int]],
    fixed: Mapping[tuple[str, int], float],
    moduli: Mapping[str, tuple[float, float]] | None,
) -> dict[str, tuple[float, float]] | None:
    """Solve for the moduli sought; with `moduli` to weigh by, also correct the displacements. None where a cell is inverted."""
    systems = [t.system(sought, fixed, moduli) for t in load_cases]
    reference = float(np.mean([v for (_, which), v in fixed.items() if which == 0]))
    whitened = [tuple(solve_triangular(s.factor, a, lower=True) for a in (s.matrix, s.right)) for s in systems]
    values = _bounded(np.vstack([w[0] for w in whitened]), np.concatenate([w[1] for w in whitened]), reference)
    if moduli is not None:
        for t, s in zip(load_cases, systems, strict=True):
            error = t.sd.ravel() * (s.scaled.T @ cho_solve((s.factor, True), s.matrix @ values - s.right))
            t.displacement = t.source.displacement - error.reshape(-1, 3)
            if t.assembler.forces(t.displacement)[2] <= 0.0:
                return None
    both = dict(fixed) | dict(zip(sought, values.tolist(), strict=True))
    return {name: (both[name, 0], both[name, 1]) for name, _ in both}


def _bounded(matrix: FloatArray, right: FloatArray, reference: float) -> FloatArray:
    """Bounded least squares with columns scaled to one length."""
    length = np.linalg.norm(matrix, axis=0)
    if not (length > 0.0).all():
        raise InputError("a material has no cell at a node in the inside of the marker lattice; leave it out or give its modulus")
    found = lsq_linear(matrix / length, right, bounds=(SMALLEST * reference * length, LARGEST * reference * length), method="bvls")
    return np.asarray(found.x / length)


def _young(mu: float, lame_lambda: float) -> tuple[float, float]:
    """Young's modulus and Poisson's ratio of Lame's parameters."""
    nu = lame_lambda / (2.0 * (lame_lambda + mu))
    return 2.0 * mu * (1.0 + nu), nu


def _require_solvable(meshes: Sequence[MarkerMesh], known: Mapping[str, float], unknown: Sequence[str]) -> None:
    """Refuse systems without a scale, with too few equations, or with an unknown material that nothing ties to a known one."""
    if not known:
        raise InputError("the equilibrium gap gives ratios of moduli: name a material of the experiments whose Young's modulus is known")
    if not unknown:
        raise InputError(f"no material is unknown: {', '.join(known)} are all given")
    equations = 3 * sum(len(m.interior) for m in meshes)
    if equations < 2 * len(unknown) + len(known):
        raise InputError(
            f"{equations} equilibrium equations are too few for {len(unknown)} unknown materials; use 3 x 3 x 3 markers or more"
        )
    reached = set(known)
    groups = [{m.mesh.region_names[r] for r in np.unique(regions)} for m in meshes for regions in _regions_at(m)]
    for _ in unknown:
        for group in groups:
            reached |= group if group & reached else set()
    if lost := [name for name in unknown if name not in reached]:
        raise InputError(f"no known material touches {', '.join(lost)} in the lattice; give another modulus")


def _regions_at(mesh: MarkerMesh) -> list[IntArray]:
    """Regions of the eight cells at every interior node."""
    nodes = mesh.mesh.cells.ravel()
    order = np.argsort(nodes, kind="stable")
    first = np.searchsorted(nodes[order], mesh.interior)
    return [mesh.mesh.regions[order[at : at + 8] // 8] for at in first]
