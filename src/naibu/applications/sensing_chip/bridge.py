"""Piezoresistors in Wheatstone half bridges: equations (23) to (27) of the paper in chapter 6 of :cite:t:`hirai2008`, from stress tensors.

Every bridge has two series pairs of piezoresistors; two equal reference resistors complete it. All lie on the beams' axes, so that the
symmetry of the chip decouples the bridges:

- F_z: outer ends of beams A and B, against their inner ends (the report's Fig. 6);
- M_y: inner end of A and outer end of B, against outer end of A and inner end of B;
- M_x: the same of D and C.

The report does not print the layout of the moments' resistors: this one is assumed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.sensing_chip.design import ChipDesign, beam_points
from naibu.applications.sensing_chip.finite_elements import ChipResponse
from naibu.core.arrays import FloatArray

BRIDGES = ("F_z", "M_x", "M_y")
MEASURED = (2, 3, 4)  # of the six loads, those that have a bridge
_SAMPLES = 5  # points along a resistor
Place = tuple[str, float]  # beam, and distance of the centre from its outer end, mm


def layout(design: ChipDesign) -> dict[str, tuple[tuple[Place, Place], tuple[Place, Place]]]:
    """Return, for every bridge, the places of the two piezoresistors in the first and in the second series pair."""
    length = design.beam_length_mm
    f, m = design.force_resistor_mm, design.moment_resistor_mm

    def moment(positive: str, negative: str) -> tuple[tuple[Place, Place], tuple[Place, Place]]:
        return ((positive, length - m), (negative, m)), ((positive, m), (negative, length - m))

    return {
        "F_z": ((("A", f), ("B", f)), (("A", length - f), ("B", length - f))),
        "M_x": moment("D", "C"),
        "M_y": moment("A", "B"),
    }


def half_bridge(first: ArrayLike, second: ArrayLike, supply: float, *, exact: bool = False) -> FloatArray:
    """Return the output of a half bridge that is balanced without stress, equation (23) with r = 1.

    Parameters
    ----------
    first, second : array_like
        Relative changes of resistance of the two series pairs.
    supply : float
        V_in, V.
    exact : bool
        Whether the resistors' share of the supply is computed without linearisation; both agree for opposite changes.

    Returns
    -------
    ndarray
        V.
    """
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    return np.asarray(supply * (a - b) / (2.0 * (2.0 + a + b) if exact else 4.0))


def sensitivity_matrix(response: ChipResponse, *, shift_mm: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """Return the output of every bridge per unit of every load (3, 6), mV/mN and mV/(mN mm), from finite elements.

    The whole stress tensor counts, averaged along each resistor.

    Parameters
    ----------
    response : ChipResponse
        Of the chip.
    shift_mm : tuple of float
        Misalignment of the resistors' mask along x and y, mm.
    """
    design = response.design
    along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    matrix = np.zeros((len(BRIDGES), 6))
    for row, pairs in enumerate(layout(design).values()):
        changes = []
        for pair in pairs:
            of_pair = np.zeros(6)
            for beam, centre in pair:
                points = beam_points(design, beam, centre + design.resistor_length_mm * along, shift_mm)
                current = np.eye(3)[0 if beam in "AB" else 1]
                change = design.piezoresistance.relative_change(response.stress_at(points), current, design.axes)
                of_pair += 0.5 * change.mean(axis=1)
            changes.append(of_pair)
        matrix[row] = 1e3 * half_bridge(changes[0], changes[1], design.supply_voltage)
    return matrix


def closed_form_sensitivities(design: ChipDesign) -> FloatArray:
    """Return the sensitivities (3,) to F_z, mV/mN, and to M_x and M_y, mV/(mN mm), of the closed forms: equations (1), (19) and (27)."""
    beams, x, y = design.closed_forms, *design.axes[:2]
    along, across = design.piezoresistance.longitudinal(x), design.piezoresistance.longitudinal(y)
    m = design.moment_resistor_mm
    bending = (beams.bending_stress(design.beam_length_mm - m) - beams.bending_stress(m)) / beams.moment_stiffness
    of_force = half_bridge(along * beams.force_stress(design.force_resistor_mm), -along * beams.force_stress(design.force_resistor_mm), 1.0)
    of_moment = half_bridge(0.5 * bending, -0.5 * bending, 1.0)
    return np.asarray(1e3 * design.supply_voltage * np.array([of_force, across * of_moment, along * of_moment]))


def sensitivity_by_place(response: ChipResponse, distance_mm: FloatArray) -> FloatArray:
    """Return what the sensitivities to F_z and M_y (2, n) would be with short resistors elsewhere on the axes, mV/mN and mV/(mN mm).

    Parameters
    ----------
    response : ChipResponse
        Of the chip.
    distance_mm : ndarray, shape (n,)
        Distance of the resistors from the ends of the beams, mm.
    """
    design = response.design

    def changes(distance: FloatArray) -> FloatArray:
        stress = response.stress_at(beam_points(design, "A", distance))[[2, 4]]
        return design.piezoresistance.relative_change(stress, np.eye(3)[0], design.axes)

    outer, inner = changes(distance_mm), changes(design.beam_length_mm - distance_mm)
    # beam B bears the same as A under a force, the opposite under a moment
    of_force = half_bridge(outer[0], inner[0], design.supply_voltage)
    moment = 0.5 * (inner[1] - outer[1])
    return np.asarray(1e3 * np.stack([of_force, half_bridge(moment, -moment, design.supply_voltage)]))


def crosstalk(matrix: FloatArray, full_scale: ArrayLike) -> FloatArray:
    """Return the output of every bridge at the full scale of every load, over its output at that of its own load (3, 6).

    Parameters
    ----------
    matrix : ndarray, shape (3, 6)
        Sensitivities.
    full_scale : array_like, shape (6,)
        Of F_x, F_y, F_z, M_x, M_y, M_z, mN and mN mm.
    """
    outputs = matrix * np.asarray(full_scale, dtype=float)
    return np.asarray(outputs / np.abs(outputs[np.arange(len(matrix)), list(MEASURED)])[:, None])


def decoupled(voltages: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return F_z, M_x, M_y (n, 3), mN and mN mm, from bridge outputs (n, 3), mV, by the inverse of the sensitivities (3, 6)."""
    return np.asarray(np.linalg.solve(matrix[:, list(MEASURED)], voltages.T).T)
