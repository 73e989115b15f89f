"""Load cases with a measured displacement field, and the zones of cells whose moduli are sought."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.meshing.surface import boundary_nodes

KNOWN = -1
POISSON_RATIO, POISSON_RATIO_SD = 0.45, 0.03  # of a known material of which only Young's modulus is stated


@dataclass(frozen=True, slots=True, eq=False)
class FieldLoadCase:
    """One load case of a body whose inner displacement was measured as a field.

    Attributes
    ----------
    name : str
        For messages.
    field : DisplacementField
        Measured displacement, at any points inside the body; the voxels of a grid become a list of points.
    loaded : ndarray, shape (n, d), bool
        Components of the model's nodes with unmeasured forces (floor, plates, clamps): no equilibrium equation holds there.
    external_force : ndarray, shape (n, d)
        Known forces on the nodes (weight, a measured push), mN.
    """

    name: str
    field: DisplacementField
    loaded: BoolArray
    external_force: FloatArray

    @classmethod
    def of(
        cls, name: str, field: DisplacementField, mesh: Mesh, *, loaded: ArrayLike, external_force: ArrayLike | None = None
    ) -> FieldLoadCase:
        """Check and make a load case; `loaded` is a mask (n, d) of components or (n,) of nodes.

        Raises
        ------
        InputError
            Shapes that do not fit the mesh, a force that is not finite, or a field without a valid point.
        """
        field, shape = field.at_points(), mesh.points.shape
        mask = np.asarray(loaded, dtype=bool)
        mask = np.repeat(mask[:, None], shape[1], axis=1) if mask.ndim == 1 else mask.copy()
        force = np.zeros(shape) if external_force is None else np.array(external_force, dtype=float)
        if mask.shape != shape or force.shape != shape:
            raise InputError(
                f"load case {name!r}: loaded and external_force must be for {shape[0]} nodes, not {mask.shape} and {force.shape}"
            )
        if not np.isfinite(force).all():
            raise InputError(f"load case {name!r}: external_force must be finite, mN")
        if field.points.shape[1] != shape[1]:
            raise InputError(f"load case {name!r}: the field has {field.points.shape[1]} coordinates, the mesh {shape[1]}")
        if not field.valid.any():
            raise InputError(f"load case {name!r}: the field has no valid point")
        return cls(name, field, mask, force)

    @property
    def n_data(self) -> int:
        """Number of measured components."""
        return int(self.field.valid.sum() * self.field.points.shape[1])


@dataclass(frozen=True, slots=True)
class KnownRegion:
    """A region of known moduli, and how well they are known.

    Attributes
    ----------
    name : str
        The region.
    young_modulus, poisson_ratio : float
        Young's modulus, kPa, and Poisson's ratio.
    young_modulus_sd : float
        Relative standard deviation of Young's modulus.
    poisson_ratio_sd : float
        Standard deviation of Poisson's ratio.
    is_unit : bool
        Whether its modulus is not known, but the unit of the others.
    is_rigid : bool
        Whether its modulus stands for a rigid body, so that other values of it say nothing.
    """

    name: str
    young_modulus: float
    poisson_ratio: float
    young_modulus_sd: float = 0.0
    poisson_ratio_sd: float = 0.0
    is_unit: bool = False
    is_rigid: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Zones:
    """Which cells share one pair of unknown moduli, and which are known.

    Attributes
    ----------
    of_cell : ndarray, shape (m,), int64
        Zone of every cell, -1 where its moduli are known.
    names : tuple of str
        Name of every zone.
    known_lambda, known_mu : ndarray, shape (m,)
        Lame parameters of the known cells, kPa; NaN elsewhere.
    known : tuple of KnownRegion
        What is known, by region.
    region_of_cell : ndarray, shape (m,), int64, or None
        Index into `known` for every cell, -1 elsewhere.
    """

    of_cell: IntArray
    names: tuple[str, ...]
    known_lambda: FloatArray
    known_mu: FloatArray
    known: tuple[KnownRegion, ...] = ()
    region_of_cell: IntArray | None = None

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        *,
        known: Mapping[str, tuple[float, float]],
        each_cell: bool | Sequence[str] = False,
        known_sd: Mapping[str, tuple[float, float]] | None = None,
        relative: bool = False,
        rigid: Collection[str] = (),
    ) -> Zones:
        """Make one zone of every region that is not known, or of every cell of it.

        Parameters
        ----------
        mesh : Mesh
            The model.
        known : mapping
            Young's modulus, kPa, and Poisson's ratio of the known regions; empty where a known force gives the scale.
        each_cell : bool or sequence of str
            Whether every cell (of these regions) is a zone of its own.
        known_sd : mapping, optional
            Relative standard deviation of Young's modulus and standard deviation of Poisson's ratio of known regions; it becomes part of
            the uncertainty of what is identified. Zero by default.
        relative : bool
            Whether Young's moduli of the known regions are not known, but the unit of the others.
        rigid : collection of str
            Known regions whose moduli stand for those of rigid bodies; no other values of these are tried.

        Raises
        ------
        InputError
            A region that the mesh lacks, nothing unknown, or moduli that no elastic solid has.
        """
        doubt = dict(known_sd or {})
        for name in [*known, *doubt, *(each_cell if not isinstance(each_cell, bool) else ())]:
            if name not in mesh.region_names:
                raise InputError(f"region {name!r} does not exist; the mesh has {', '.join(mesh.region_names)}")
        if apart := [name for name in rigid if name not in known]:
            raise InputError(f"rigid names {apart[0]!r}, whose moduli `known` does not state")
        of_cell = np.full(mesh.n_cells, KNOWN, dtype=np.int64)
        lame, shear = np.full(mesh.n_cells, np.nan), np.full(mesh.n_cells, np.nan)
        names: list[str] = []
        region_of_cell = np.full(mesh.n_cells, KNOWN, dtype=np.int64)
        regions: list[KnownRegion] = []
        for index, region in enumerate(mesh.region_names):
            cells = np.flatnonzero(mesh.regions == index)
            if region in known:
                lame[cells], shear[cells] = lame_parameters(*known[region])
                region_of_cell[cells] = len(regions)
                sd = doubt.get(region, (0.0, 0.0))
                regions.append(KnownRegion(region, *known[region], *sd, is_unit=relative, is_rigid=region in rigid))
            elif each_cell if isinstance(each_cell, bool) else region in each_cell:
                of_cell[cells] = len(names) + np.arange(len(cells))
                names += [f"{region}: cell {c}" for c in cells]
            elif len(cells):
                of_cell[cells] = len(names)
                names.append(region)
        if not names:
            raise InputError("every region is known: leave out of `known` what is to be identified")
        return cls(of_cell, tuple(names), lame, shear, tuple(regions), region_of_cell)

    def of_one_material(self) -> Zones:
        """Return the zones with all that is not known as one of them."""
        return replace(self, of_cell=np.where(self.of_cell == KNOWN, KNOWN, 0), names=("body",))

    @property
    def count(self) -> int:
        """Number of unknown zones."""
        return len(self.names)

    @property
    def in_rigid_region(self) -> BoolArray:
        """Whether a cell (m,) lies in a known region that is called rigid."""
        if self.region_of_cell is None:
            return np.zeros(len(self.of_cell), dtype=bool)
        rigid = np.array([*(region.is_rigid for region in self.known), False])
        return rigid[self.region_of_cell]

    @property
    def unit(self) -> str:
        """Unit of moduli after a number: none where that of a region is the unit."""
        return "" if any(region.is_unit for region in self.known) else " kPa"

    def per_cell(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return lambda and mu of every cell (m,), kPa, from those of the zones (count,)."""
        unknown = self.of_cell != KNOWN
        out = self.known_lambda.copy(), self.known_mu.copy()
        for full, given in zip(out, (lame_lambda, shear_modulus), strict=True):
            full[unknown] = np.asarray(given, dtype=float)[self.of_cell[unknown]]
        return out


def is_surface_sought(mesh: Mesh, load_cases: Sequence[FieldLoadCase]) -> bool:
    """Return whether forces may act on the whole surface of a body in space, whose motion is sought, in a load case."""
    if mesh.dimension != 3:
        return False
    surface = boundary_nodes(mesh)
    return any(bool(case.loaded[surface].all()) for case in load_cases)
