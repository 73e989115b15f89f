"""Virtual twin of the dough of the 2008 report :cite:p:`hirai2008` (chapter 4.3): compressed, captured by two cameras and force sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.forward_model import Capture, PushedFace, PushedLattice, Pushing
from naibu.identification.lattice_calibration.unknowns import LatticeUnknowns
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, box_mask, classic_lattice

Law = Literal["same", "zones", "finer"]

DOUGH_CM, DOUGH_G = (10, 5, 7), 510.0
CUBE_CM, CUBE_G = (8, 8, 8), 630.0
VIEWS = ((-0.55, -0.65, 0.52), (0.55, 0.65, 0.52))  # from the object towards the cameras
POINT_SD_MM, FORCE_SD_MN = 0.5, 50.0
POINTS = 2800
# K (mN/mm), C1, C2 (mN s/mm) between masses 10 mm apart: relaxation within the two seconds of keeping, some newtons of force
TRUTH = {
    "K short": 60.0, "K normal": 40.0, "K long": 25.0,
    "C1 short": 30.0, "C1 normal": 18.0, "C1 long": 12.0,
    "C2 short": 90.0, "C2 normal": 70.0, "C2 long": 50.0,
}  # fmt: skip
SURFACE_FACTOR = {"K": 1.3, "C1": 1.2, "C2": 0.8}  # a dried skin, in the law with zones

# The closing speed is 20 mm/s, half of it for each of two facing bodies; each covers the middle of its face, which turns concave.
FIRST = Pushing(
    "first pushing",
    (PushedFace((0.0, 10.0, 20.0), (0.0, 40.0, 50.0), (10.0, 0.0, 0.0)),
     PushedFace((100.0, 10.0, 20.0), (100.0, 40.0, 50.0), (-10.0, 0.0, 0.0))),
    1.0, 2.0, 2.0, (0.0, 0.5, 1.0, 3.0, 5.0),
)  # fmt: skip
SECOND = Pushing(
    "second pushing",
    (PushedFace((30.0, 0.0, 20.0), (70.0, 0.0, 50.0), (0.0, 10.0, 0.0)),
     PushedFace((30.0, 50.0, 20.0), (70.0, 50.0, 50.0), (0.0, -10.0, 0.0))),
    0.7, 2.0, 2.0, (0.0, 0.34, 0.7, 2.7, 4.7),
)  # fmt: skip
CUBE_PUSHING = Pushing(
    "pushing of the cube",
    (PushedFace((0.0, 30.0, 30.0), (0.0, 50.0, 50.0), (10.0, 0.0, 0.0)),
     PushedFace((80.0, 30.0, 30.0), (80.0, 50.0, 50.0), (-10.0, 0.0, 0.0))),
    1.0, 2.0, 2.0, (0.0, 0.5, 1.0, 3.0, 5.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    """A virtual object with the parameters that made its captures.

    Attributes
    ----------
    lattice : Lattice
        The truth's lattice.
    parameters : LatticeParameters
        Of its elements.
    captures : tuple of Capture
        What was seen of each pushing.
    """

    lattice: Lattice
    parameters: LatticeParameters
    captures: tuple[Capture, ...]


def dough_lattice(spacing_mm: float = 10.0, *, size_cm: Sequence[int] = DOUGH_CM, mass_g: float = DOUGH_G) -> Lattice:
    """Return the lattice of a block of dough, by default 10 x 5 x 7 cm of 510 g; all masses alike, as in the report.

    Raises
    ------
    InputError
        A spacing that does not divide the edges.
    """
    cells = [10.0 * edge / spacing_mm for edge in size_cm]
    if any(abs(c - round(c)) > 1e-9 for c in cells):
        raise InputError(f"a spacing of {spacing_mm:g} mm does not divide edges of {', '.join(f'{10 * e:g}' for e in size_cm)} mm")
    nx, ny, nz = (round(c) for c in cells)
    return classic_lattice(box_mask((nx, ny, nz)), spacing_mm, total_mass_kg=1e-3 * mass_g, lumping="equal")


def dough_parameters(lattice: Lattice, values: ArrayLike | dict[str, float] | None = None, *, zones: bool = False) -> LatticeParameters:
    """Return parameters of a lattice of any spacing from those between masses 10 mm apart, by default `TRUTH`.

    A finer lattice of the same solid has elements that are weaker in proportion to the spacing; with `zones` those at the surface differ by
    `SURFACE_FACTOR`.
    """
    unknowns = LatticeUnknowns.of(lattice, zones=zones)
    given = dict(TRUTH) if values is None else values
    if zones and isinstance(given, dict):
        given = {
            name: given[name.rsplit(" ", 1)[0]] * (SURFACE_FACTOR[name.split()[0]] if name.endswith("surface") else 1.0)
            for name in unknowns.names
        }
    return unknowns.parameters(unknowns.vector(given) * (lattice.spacing_mm / 10.0))


def virtual_capture(
    lattice: Lattice,
    parameters: LatticeParameters,
    pushing: Pushing,
    *,
    seed: int,
    points: int = POINTS,
    point_sd_mm: float = POINT_SD_MM,
    force_sd_mn: float = FORCE_SD_MN,
) -> Capture:
    """Push a lattice, and return what two stereo cameras and a force sensor on each indenter see of it, with noise.

    A camera sees the faces that look towards it, but neither the floor nor those that an indenter covers while it touches them; points are
    spread evenly over what each camera sees, half of them for each. (Faces hide no other faces: shallow dents only.)

    Parameters
    ----------
    lattice, parameters : Lattice, LatticeParameters
        The truth.
    pushing : Pushing
        What is done.
    seed : int
        Of the noise and of the choice of points.
    points : int
        About how many points a capture has.
    point_sd_mm, force_sd_mn : float
        Standard deviation of a coordinate, and of a component of a force in one sample.
    """
    rng = np.random.default_rng(seed)
    pushed = PushedLattice.of(lattice, pushing)
    motion = pushed.run(parameters, tolerance=1e-3)
    touched = pushing.touched(lattice)
    corners = pushed.hull.triangles
    covered = np.any([np.isin(corners, nodes).all(axis=1) for nodes in touched], axis=0)
    on_floor = (lattice.points[corners][:, :, 2] == lattice.points[:, 2].min()).all(axis=1)
    clouds = []
    for time, x in zip(pushing.capture_s, motion.positions, strict=True):
        hidden = on_floor | (covered & (0.0 < time <= pushing.contact_s))
        clouds.append(_seen(x[corners[~hidden]], points, rng) + 0.0)
    noisy = [cloud + point_sd_mm * rng.standard_normal(cloud.shape) for cloud in clouds]
    force = motion.force + force_sd_mn * rng.standard_normal(motion.force.shape)
    return Capture.of(pushing, noisy, force, lattice, point_sd_mm=point_sd_mm, force_sd_mn=force_sd_mn)


def _seen(triangles: FloatArray, points: int, rng: np.random.Generator) -> FloatArray:
    """Return points (k, 3) spread over those of the triangles (t, 3, 3) that look towards either camera."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    clouds = []
    for view in VIEWS:
        towards = np.array(view) / np.linalg.norm(view)
        area = np.maximum(normal @ towards, 0.0)  # a camera spreads its pixels over what it sees of a face
        chosen = rng.choice(len(area), points // len(VIEWS), p=area / area.sum())
        u, w = rng.random((2, len(chosen)))
        over = u + w > 1.0
        u, w = np.where(over, 1.0 - u, u)[:, None], np.where(over, 1.0 - w, w)[:, None]
        clouds.append(a[chosen] + u * (b - a)[chosen] + w * (c - a)[chosen])
    return np.concatenate(clouds)


def dough_twin(
    pushings: Sequence[Pushing] = (FIRST, SECOND), *, law: Law = "same", spacing_mm: float = 10.0, seed: int = 0, points: int = POINTS
) -> Twin:
    """Return the virtual dough and what was captured of pushings.

    Parameters
    ----------
    pushings : sequence of Pushing
        What is done, each to a new object.
    law : str
        ``"same"``: the truth is a lattice of this spacing with nine parameters; ``"zones"``: its surface elements differ; ``"finer"``:
        masses at half the spacing, and surface elements differ, so that no parameters of a lattice of this spacing fit exactly.
    spacing_mm : float
        Of the model that is to be calibrated.
    seed : int
        Of noise and choice of points.
    points : int
        Captured points, about.

    Raises
    ------
    InputError
        An unknown law.
    """
    if law not in ("same", "zones", "finer"):
        raise InputError(f"laws are 'same', 'zones' and 'finer', not {law!r}")
    lattice = dough_lattice(spacing_mm / 2.0 if law == "finer" else spacing_mm)
    parameters = dough_parameters(lattice, zones=law != "same")
    captures = tuple(virtual_capture(lattice, parameters, p, seed=seed + 1000 * k, points=points) for k, p in enumerate(pushings))
    return Twin(lattice, parameters, captures)
