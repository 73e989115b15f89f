"""Dimensions and materials of a cross-beam sensing chip, and where its piezoresistors lie."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from naibu.applications.sensing_chip.closed_forms import CrossBeam
from naibu.applications.sensing_chip.piezoresistance import Piezoresistance, doping_factor, p_type_silicon
from naibu.core.arrays import FloatArray, require_positive
from naibu.core.errors import InputError
from naibu.mechanics.small_strain.cubic_elasticity import CubicCrystal, crystal_frame, silicon

SILICON_DENSITY = 2.329e-6  # kg/mm^3
_LARGEST_MM = 100.0  # no chip is larger: the unit must be another


@dataclass(frozen=True, slots=True)
class ChipDesign:
    """A square block on four beams in a cross, of one crystal, with piezoresistors on the beams' upper surface.

    The chip's frame is right-handed: x along beams A (x < 0) and B, y along beams C (y < 0) and D, z up; its origin is the block's centre,
    half a thickness below the upper surface. A force F_z is positive where it presses the block down.

    Attributes
    ----------
    beam_length_mm, beam_width_mm, beam_thickness_mm : float
        Of every beam, mm.
    block_half_width_mm : float
        Distance from the centre to the beams, mm.
    block_height_mm : float
        Of block and frame, from the upper surface down, mm.
    frame_width_mm : float
        Of the ring around the beams that carries them, mm.
    pillar_width_mm : float
        Edge of the square on which the load acts, mm.
    pillar_mass_kg : float
        Mass that moves with the block, kg.
    force_resistor_mm, moment_resistor_mm : float
        Distance of the piezoresistors' centres from the end of the beam, for F_z and for the moments, mm.
    resistor_length_mm : float
        Along the beam, mm.
    supply_voltage : float
        Of the bridges, V.
    strength_kpa : float
        Largest principal stress that the silicon is trusted to bear, kPa.
    doping_per_cm3 : float, optional
        Concentration of acceptors in the piezoresistors; lightly doped by default.
    beam_direction, wafer_normal : tuple of int
        Miller indices of x and z.

    Raises
    ------
    InputError
        A size, mass, voltage or strength that is not positive, resistors that do not fit on the beam, beams wider than the block, or
        crystal directions that are not perpendicular.
    """

    beam_length_mm: float
    beam_width_mm: float
    beam_thickness_mm: float
    block_half_width_mm: float
    block_height_mm: float
    frame_width_mm: float
    pillar_width_mm: float
    pillar_mass_kg: float
    force_resistor_mm: float
    moment_resistor_mm: float
    resistor_length_mm: float
    supply_voltage: float
    strength_kpa: float
    doping_per_cm3: float | None = None
    beam_direction: tuple[int, int, int] = (1, 1, 0)
    wafer_normal: tuple[int, int, int] = (0, 0, 1)

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, float | int):
                require_positive(entry.name, value)
            if entry.name.endswith("_mm") and value > _LARGEST_MM:
                raise InputError(f"{entry.name} is {value:g} mm, and no chip is larger than {_LARGEST_MM:g} mm; give millimetres")
        if self.beam_width_mm > 2.0 * self.block_half_width_mm:
            raise InputError(
                f"beam_width_mm is {self.beam_width_mm:g}, more than the block, whose half width block_half_width_mm is "
                f"{self.block_half_width_mm:g} mm; make the beams narrower"
            )
        if self.beam_thickness_mm > self.block_height_mm:
            raise InputError(
                f"beam_thickness_mm is {self.beam_thickness_mm:g}, more than block_height_mm = {self.block_height_mm:g}; make it less"
            )
        if self.pillar_width_mm > 2.0 * self.block_half_width_mm:
            raise InputError(f"pillar_width_mm is {self.pillar_width_mm:g}, more than the block; make it less")
        for name in ("force_resistor_mm", "moment_resistor_mm"):
            centre = getattr(self, name)
            if not 0.5 * self.resistor_length_mm <= centre <= 0.5 * (self.beam_length_mm - self.resistor_length_mm):
                raise InputError(
                    f"{name} is {centre:g}; resistors of {self.resistor_length_mm:g} mm fit on one half of a beam of "
                    f"{self.beam_length_mm:g} mm between {0.5 * self.resistor_length_mm:g} and "
                    f"{0.5 * (self.beam_length_mm - self.resistor_length_mm):g} mm from its end"
                )
        crystal_frame(self.beam_direction, self.wafer_normal)

    @property
    def crystal(self) -> CubicCrystal:
        """Elasticity of the silicon."""
        return silicon()

    @property
    def axes(self) -> FloatArray:
        """Rows (3, 3) are x, y, z of the chip in the crystal's axes."""
        return crystal_frame(self.beam_direction, self.wafer_normal)

    @property
    def stiffness_tensor(self) -> FloatArray:
        """Stiffness tensor (3, 3, 3, 3) of the silicon in the frame of the chip, kPa."""
        return self.crystal.stiffness_tensor(self.axes)

    @property
    def piezoresistance(self) -> Piezoresistance:
        """Piezoresistance coefficients at the doping."""
        return p_type_silicon(1.0 if self.doping_per_cm3 is None else doping_factor(self.doping_per_cm3))

    @property
    def closed_forms(self) -> CrossBeam:
        """The report's formulas with the moduli of the crystal along the beams."""
        x, y, _ = self.axes
        return CrossBeam.of(
            self.beam_length_mm, self.beam_width_mm, self.beam_thickness_mm, self.block_half_width_mm,
            self.crystal.young_modulus(x), self.crystal.shear_modulus(x, y),
        )  # fmt: skip

    @property
    def block_mass_kg(self) -> float:
        """Mass of block and pillar, kg."""
        return float(SILICON_DENSITY * (2.0 * self.block_half_width_mm) ** 2 * self.block_height_mm + self.pillar_mass_kg)

    @property
    def block_inertia(self) -> float:
        """Moment of inertia of the block about x or y through the origin, kg mm^2; the pillar's mass is taken at the origin."""
        mass = self.block_mass_kg - self.pillar_mass_kg
        below = 0.5 * (self.block_height_mm - self.beam_thickness_mm)
        return float(mass * ((2.0 * self.block_half_width_mm) ** 2 / 12.0 + self.block_height_mm**2 / 12.0 + below**2))


def assumed_chip() -> ChipDesign:
    """Return a chip of 2 x 2 mm^2 with assumed dimensions, for which the closed forms give the published sensitivities.

    The 2008 report :cite:p:`hirai2008` (chapter 6) prints neither dimensions nor supply voltage nor the places of the resistors.
    With a supply of 5 V, the piezoresistance of lightly doped silicon, and the same nominal stress at either printed load limit, beams of
    325 x 121 x 74 um^3 on a block of 325 um give its 0.2 mV/mN and 2.83 mV/(N um); block height, frame, pillar and strength are typical.
    """
    return ChipDesign(
        beam_length_mm=0.325,
        beam_width_mm=0.121,
        beam_thickness_mm=0.074,
        block_half_width_mm=0.1625,
        block_height_mm=0.4,
        frame_width_mm=0.5125,
        pillar_width_mm=0.2,
        pillar_mass_kg=1e-7,
        force_resistor_mm=0.113,
        moment_resistor_mm=0.0325,
        resistor_length_mm=0.02,
        supply_voltage=5.0,
        strength_kpa=2e6,
    )


def beam_points(design: ChipDesign, beam: str, distance_mm: FloatArray, offset_mm: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """Return points (n, 3), mm, on the upper surface of a beam, on its axis.

    Parameters
    ----------
    design : ChipDesign
        The chip.
    beam : {"A", "B", "C", "D"}
        At x < 0, x > 0, y < 0 or y > 0.
    distance_mm : ndarray, shape (n,)
        From the beam's outer end, mm.
    offset_mm : tuple of float
        Shift of the points along x and y, mm: a misaligned mask.
    """
    from_centre = design.block_half_width_mm + design.beam_length_mm - distance_mm
    axis, sign = {"A": (0, -1.0), "B": (0, 1.0), "C": (1, -1.0), "D": (1, 1.0)}[beam]
    points = np.zeros((len(distance_mm), 3))
    points[:, axis] = sign * from_centre
    points[:, :2] += offset_mm
    points[:, 2] = 0.5 * design.beam_thickness_mm
    return points
