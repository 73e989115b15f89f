"""Loads that the beams of a chip bear: largest principal stress of combined bending and torsion against the strength of silicon.

Silicon is brittle: it breaks where the largest principal stress reaches a strength that depends on size, etching and polish, from about 1
to 8 GPa for beams of this size :cite:p:`petersen1982,wilson1996`. The stresses are nominal, of the closed forms; sharp corners raise them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.sensing_chip.design import ChipDesign, beam_points
from naibu.applications.sensing_chip.finite_elements import ChipResponse
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

_FROM_CORNERS = 0.25  # of the thickness


def largest_stress(design: ChipDesign, force: ArrayLike, moment_x: ArrayLike, moment_y: ArrayLike) -> FloatArray:
    """Return the largest nominal principal stress in the beams, kPa.

    Both faces of opposite beams bear every combination of signs, so that only the sizes of the loads count.

    Parameters
    ----------
    design : ChipDesign
        The chip.
    force : array_like
        F_z, mN.
    moment_x, moment_y : array_like
        mN mm (1 mN mm = 1 N um).
    """
    beams = design.closed_forms
    f = np.abs(np.asarray(force, dtype=float)) * float(beams.force_stress(0.0))
    bending = max(abs(float(beams.bending_stress(x))) for x in (0.0, design.beam_length_mm)) / float(beams.moment_stiffness)
    shear = float(beams.torsion_stress * beams.end_torque / beams.moment_stiffness)
    m_x, m_y = (np.abs(np.asarray(m, dtype=float)) for m in (moment_x, moment_y))
    worst = [0.5 * s + np.sqrt(0.25 * s**2 + t**2) for s, t in ((f + bending * m_y, shear * m_x), (f + bending * m_x, shear * m_y))]
    return np.asarray(np.maximum(*worst))


def load_limits(design: ChipDesign) -> FloatArray:
    """Return the largest F_z, mN, M_x and M_y, mN mm, that the chip bears, each alone (3,)."""
    return design.strength_kpa / np.array([float(largest_stress(design, *unit)) for unit in np.eye(3)])


def load_envelope(design: ChipDesign, *, azimuth_deg: float = 0.0, count: int = 91) -> FloatArray:
    """Return the largest loads in the plane of force and moment.

    Parameters
    ----------
    design : ChipDesign
        The chip.
    azimuth_deg : float
        Direction of the moment from x towards y, degrees.
    count : int
        Number of points.

    Returns
    -------
    ndarray, shape (count, 2)
        F_z, mN, and size of the moment, mN mm, from the force alone to the moment alone.
    """
    return envelope_along_rays(
        load_limits(design), design.strength_kpa, lambda *load: largest_stress(design, *load), azimuth_deg=azimuth_deg, count=count
    )


def envelope_along_rays(
    limits: FloatArray,
    strength_kpa: float,
    stress: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    *,
    azimuth_deg: float,
    count: int,
) -> FloatArray:
    """Return where a stress in proportion to the load reaches the strength, on rays from the force alone to the moment alone.

    Parameters
    ----------
    limits : ndarray, shape (3,)
        Largest F_z, mN, M_x and M_y, mN mm, each alone, which set the directions of the rays.
    strength_kpa : float
        Stress that is borne.
    stress : callable
        Largest stress, kPa, under F_z, M_x and M_y, each (count,).
    azimuth_deg, count
        See `load_envelope`.

    Returns
    -------
    ndarray, shape (count, 2)
        F_z, mN, and size of the moment, mN mm.
    """
    ratio, turn = np.linspace(0.0, 0.5 * np.pi, count), np.deg2rad(azimuth_deg)
    force, moment = limits[0] * np.cos(ratio), limits[1] * np.sin(ratio)
    scale = strength_kpa / stress(force, moment * np.cos(turn), moment * np.sin(turn))
    return np.stack([scale * force, scale * moment], axis=1)


def surface_stress(response: ChipResponse, load: ArrayLike) -> FloatArray:
    """Return the largest tension on the upper and on the lower surface of the beams (2,), kPa, by finite elements.

    Points nearer than a quarter of the thickness to the ends are left out: at the sharp corners there the stress has no bound, and grows as
    the mesh is refined. Only tension counts, so that the sign of the load matters.

    Parameters
    ----------
    response : ChipResponse
        Of the chip.
    load : array_like, shape (6,)
        mN and mN mm.
    """
    design = response.design
    margin = _FROM_CORNERS * design.beam_thickness_mm
    x = np.linspace(margin, design.beam_length_mm - margin, 60)
    largest = np.zeros(2)
    for beam in "ABCD":
        for aside in (-0.4 * design.beam_width_mm, 0.0, 0.4 * design.beam_width_mm):
            points = beam_points(design, beam, x, (0.0, aside) if beam in "AB" else (aside, 0.0))
            for k, side in enumerate((1.0, -1.0)):
                stress = np.tensordot(np.asarray(load, dtype=float), response.stress_at(points * [1.0, 1.0, side]), 1)
                largest[k] = max(largest[k], float(np.linalg.eigvalsh(stress).max()))
    return largest


def require_bearable(design: ChipDesign, force: float, moment_x: float, moment_y: float) -> float:
    """Return the largest stress over the strength under a load, or refuse the load.

    Raises
    ------
    InputError
        The load is not finite, or exceeds the envelope; the message tells by how much.
    """
    used = float(largest_stress(design, force, moment_x, moment_y)) / design.strength_kpa
    if not used <= 1.0:
        trusted = design.strength_kpa * 1e-6
        raise InputError(
            f"load F_z = {force:g} mN, M_x = {moment_x:g} and M_y = {moment_y:g} N um stresses the beams to {used * trusted:.3g} GPa, "
            f"and the silicon is trusted with {trusted:.3g} GPa; make the load at most {1.0 / used:.3g} times as large"
        )
    return used
