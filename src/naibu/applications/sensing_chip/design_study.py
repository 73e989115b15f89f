"""Sizes of the beams against sensitivity, range, stiffness and resonance of a chip, and the Pareto front between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.sensing_chip.closed_forms import CrossBeam
from naibu.applications.sensing_chip.design import SILICON_DENSITY, ChipDesign
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError

SLENDER = 4.0  # least length over thickness: below, the closed forms are far off


@dataclass(frozen=True, slots=True, eq=False)
class DesignStudy:
    """Designs that differ in the sizes of their beams, by the closed forms; arrays have one entry a design.

    Attributes
    ----------
    length_mm, width_mm, thickness_mm : ndarray, shape (n,)
        Of the beams.
    force_sensitivity, moment_sensitivity : ndarray, shape (n,)
        mV/mN and mV/(N um).
    force_limit, moment_limit : ndarray, shape (n,)
        Largest force, mN, and moment, N um, each alone.
    force_stiffness, moment_stiffness : ndarray, shape (n,)
        mN/mm and N um/rad.
    force_resonance, tilt_resonance : ndarray, shape (n,)
        Of the block moving along z and turning, Hz.
    """

    length_mm: FloatArray
    width_mm: FloatArray
    thickness_mm: FloatArray
    force_sensitivity: FloatArray
    moment_sensitivity: FloatArray
    force_limit: FloatArray
    moment_limit: FloatArray
    force_stiffness: FloatArray
    moment_stiffness: FloatArray
    force_resonance: FloatArray
    tilt_resonance: FloatArray

    def front(self, *objectives: str) -> BoolArray:
        """Return which designs are not worse in all of the named quantities, each to be large, than another (n,)."""
        return pareto_front(np.stack([getattr(self, name) for name in objectives], axis=1))


def study_designs(base: ChipDesign, lengths_mm: ArrayLike, widths_mm: ArrayLike, thicknesses_mm: ArrayLike) -> DesignStudy:
    """Evaluate all combinations of beam sizes, with everything else as in `base`; the resistors move in proportion to the length.

    Combinations that cannot be made are left out: beams wider than the block, thicker than wide or than the block, and shorter than four
    thicknesses, where the closed forms fail.

    Raises
    ------
    InputError
        Sizes that are not positive, or no combination that is left.
    """
    grid = np.meshgrid(*(np.asarray(v, dtype=float).ravel() for v in (lengths_mm, widths_mm, thicknesses_mm)), indexing="ij")
    length, width, thickness = (axis.ravel() for axis in grid)
    if not (min(length.min(), width.min(), thickness.min()) > 0.0 and np.isfinite(length + width + thickness).all()):
        raise InputError("lengths_mm, widths_mm and thicknesses_mm must be positive")
    keep = (
        (width <= 2.0 * base.block_half_width_mm) & (thickness <= np.minimum(width, base.block_height_mm)) & (length >= SLENDER * thickness)
    )
    if not keep.any():
        raise InputError(
            "no combination of lengths_mm, widths_mm and thicknesses_mm can be made: beams must be at least 4 times as long as thick, as "
            f"wide as thick, and not wider than the block of {2.0 * base.block_half_width_mm:g} mm"
        )
    length, width, thickness = length[keep], width[keep], thickness[keep]
    own = base.closed_forms
    beams = CrossBeam.of(length, width, thickness, base.block_half_width_mm, own.young_modulus, own.shear_modulus)
    x_f, x_m = (length * place / base.beam_length_mm for place in (base.force_resistor_mm, base.moment_resistor_mm))
    coefficient = 1e3 * base.supply_voltage * base.piezoresistance.longitudinal(base.beam_direction)
    bending = (beams.bending_stress(length - x_m) - beams.bending_stress(x_m)) / beams.moment_stiffness
    largest = beams.bending_stress(length) / beams.moment_stiffness
    shear = beams.torsion_stress * beams.end_torque / beams.moment_stiffness
    # of a beam bent as its ends move apart, 13/35 of the mass moves with the block
    mass = base.block_mass_kg + 4.0 * 13.0 / 35.0 * SILICON_DENSITY * length * width * thickness
    return DesignStudy(
        length, width, thickness,
        0.5 * coefficient * beams.force_stress(x_f), 0.25 * coefficient * bending,
        base.strength_kpa / beams.force_stress(0.0), base.strength_kpa / np.maximum(largest, shear),
        beams.force_stiffness, beams.moment_stiffness,
        np.sqrt(beams.force_stiffness / mass) / (2.0 * np.pi), np.sqrt(beams.moment_stiffness / base.block_inertia) / (2.0 * np.pi),
    )  # fmt: skip


def pareto_front(values: FloatArray) -> BoolArray:
    """Return which rows (n,) of values (n, k), all to be large, no other row equals or exceeds everywhere while exceeding it somewhere."""
    order = np.lexsort(values.T[::-1])[::-1]
    on_front = np.zeros(len(values), dtype=bool)
    kept = np.empty((0, values.shape[1]))
    for i in order:  # a row can only be dominated by one that comes before
        if not ((kept >= values[i]).all(axis=1) & (kept > values[i]).any(axis=1)).any():
            on_front[i] = True
            kept = np.vstack([kept, values[i]])
    return on_front
