"""A soft hemispherical fingertip around the package of a sensing chip, and its finite element mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from naibu.core.arrays import FloatArray, require_count, require_positive, require_within
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, Material, material
from naibu.meshing._o_grid import round_positions, wrapped
from naibu.meshing.primitives import grid_cells

GEL, PACKAGE = 0, 1  # regions of the mesh
_CORE, _BULGE = 0.5, 0.7  # half width and bulge of the mesh's core, as those of other round solids
_LARGEST_MM = 1000.0
_ROUND = 1e-9  # mm


@dataclass(frozen=True, slots=True)
class Fingertip:
    """A hemisphere of gel whose flat side is bonded to a rigid base, with the stiff package of a sensing chip at its centre.

    The frame is that of the chip: x and y along its beams, z up from the base into the gel. The package is a half ellipsoid.

    Attributes
    ----------
    diameter_mm : float
        Of the hemisphere, mm.
    young_modulus_kpa, poisson_ratio : float
        Of the gel at small strain.
    law : str
        Constitutive law of the gel; see `naibu.mechanics.LAWS`.
    package_diameter_mm, package_height_mm : float
        Of the package at the base, and above it, mm.
    package_young_modulus_kpa : float
        Of the package, which is far stiffer than the gel.

    Raises
    ------
    InputError
        A size or modulus that is not positive, a package that does not fit into the lower half of the gel, or an unknown law.
    """

    diameter_mm: float = 20.0
    young_modulus_kpa: float = 220.0
    poisson_ratio: float = 0.49
    law: str = "neo_hookean_isochoric"
    package_diameter_mm: float = 0.9
    package_height_mm: float = 0.35
    package_young_modulus_kpa: float = 1e6

    def __post_init__(self) -> None:
        for name in ("diameter_mm", "package_diameter_mm", "package_height_mm"):
            value = require_positive(name, getattr(self, name), "mm")
            if value > _LARGEST_MM:
                raise InputError(f"{name} is {value:g} mm, and no fingertip is larger than {_LARGEST_MM:g} mm; give millimetres")
        require_positive("young_modulus_kpa", self.young_modulus_kpa, "kPa")
        require_positive("package_young_modulus_kpa", self.package_young_modulus_kpa, "kPa")
        require_within("poisson_ratio", self.poisson_ratio, 0.3, 0.4999)
        if self.law not in LAWS:
            raise InputError(f"law {self.law!r} is not known; use one of {', '.join(LAWS)}")
        for name, size in (("package_diameter_mm", self.package_diameter_mm), ("package_height_mm", 2.0 * self.package_height_mm)):
            if size > 0.5 * self.diameter_mm:
                raise InputError(
                    f"{name} is {getattr(self, name):g}, too much for a fingertip of diameter_mm = {self.diameter_mm:g}; make it smaller"
                )
        if self.package_young_modulus_kpa < 20.0 * self.young_modulus_kpa:
            raise InputError(
                f"package_young_modulus_kpa is {self.package_young_modulus_kpa:g}, less than 20 times that of the gel; a package is stiff"
            )

    @property
    def radius_mm(self) -> float:
        """Radius of the hemisphere, mm."""
        return 0.5 * self.diameter_mm

    @property
    def materials(self) -> tuple[Material, Material]:
        """Materials of gel and package."""
        return (
            material(self.law, young_modulus=self.young_modulus_kpa, poisson_ratio=self.poisson_ratio),
            material("neo_hookean_isochoric", young_modulus=self.package_young_modulus_kpa, poisson_ratio=0.35),
        )


@dataclass(frozen=True, slots=True)
class FingertipResolution:
    """Numbers of cells of a fingertip's mesh.

    Attributes
    ----------
    around : int
        Half of the cells along a side of the core: the circumference has 8 times as many.
    upwards : int
        Of the core, from the base up.
    shells : int
        Between package and surface; they grow outwards.

    Raises
    ------
    InputError
        Fewer than 2 around, 1 upwards or 4 shells, or more than 12, 12 or 60.
    """

    around: int = 4
    upwards: int = 3
    shells: int = 14

    def __post_init__(self) -> None:
        for name, least, most in (("around", 2, 12), ("upwards", 1, 12), ("shells", 4, 60)):
            require_count(name, getattr(self, name), least)
            require_within(name, getattr(self, name), least, most)


def fingertip_mesh(fingertip: Fingertip, resolution: FingertipResolution | None = None, *, whole: bool = False) -> Mesh:
    """Mesh the half of a fingertip with y >= 0: whatever presses it in the plane y = 0 deforms it symmetrically.

    Parameters
    ----------
    fingertip : Fingertip
        Dimensions.
    resolution : FingertipResolution, optional
        Numbers of cells.
    whole : bool
        Whether the other half is meshed, too.

    Returns
    -------
    Mesh
        Hexahedra with the regions ``"gel"`` and ``"package"``: the core of the package, and shells around it.
    """
    r = resolution or FingertipResolution()
    side = np.linspace(-1.0, 1.0, 2 * r.around + 1)
    up = np.linspace(0.0, 1.0, r.upwards + 1)
    gz, gy, gx = np.meshgrid(up, side, side, indexing="ij")
    cube = np.stack([gx.ravel(), gy.ravel(), gz.ravel()], axis=1)
    grid = wrapped(grid_cells(len(side), len(side), len(up)), (cube[:, 2] == 0)[None], 1 + r.shells)
    unit = round_positions(cube[grid.base], np.minimum(grid.shell, 1), _CORE, _BULGE)
    direction = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    half_axes = np.array([fingertip.package_diameter_mm, fingertip.package_diameter_mm, 2.0 * fingertip.package_height_mm]) / 2.0
    share = _shares(fingertip, r)[np.maximum(grid.shell - 1, 0)][:, None]
    outside = (1.0 - share) * half_axes * direction + share * fingertip.radius_mm * direction
    points = np.where((grid.shell <= 1)[:, None], half_axes * unit, outside)
    points[np.abs(points) < _ROUND] = 0.0
    kept = (points[grid.cells].mean(axis=1)[:, 1] > 0.0) | whole
    regions = np.where(grid.shell[grid.cells].max(axis=1) <= 1, PACKAGE, GEL)[kept]
    used, cells = np.unique(grid.cells[kept], return_inverse=True)
    return Mesh.from_arrays(points[used], cells.reshape(-1, 8), "hexahedron", regions=regions, region_names=("gel", "package"))


def _shares(fingertip: Fingertip, r: FingertipResolution) -> FloatArray:
    """Return how far each shell lies (shells + 1,) between package, 0, and surface, 1: cells near the package are as high as wide."""
    half = 0.5 * fingertip.package_diameter_mm
    first = np.pi * half / (4 * r.around)
    reach = fingertip.radius_mm - half
    steps = np.arange(r.shells + 1)
    if first * r.shells >= reach:
        return np.asarray(steps / r.shells)

    def excess(log_growth: float) -> float:
        return float(first * np.expm1(r.shells * log_growth) / np.expm1(log_growth) - reach)

    growth = brentq(excess, 1e-9, np.log1p(reach / first))
    return np.asarray(np.expm1(steps * growth) / np.expm1(r.shells * growth))
