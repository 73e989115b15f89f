"""What the user states of zones: moduli that are known, or a zone of which the others are multiples."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.units import kilopascals
from naibu.identification.from_fields.forward.load_cases import POISSON_RATIO, POISSON_RATIO_SD, Zones
from naibu.identification.from_fields.inversion.gauss_newton import Bounds

RIGID = (
    3e4  # stiffness of what is called rigid over that of the stiffest other known material: with 300 a slender bone bends by a millimetre
)
BEYOND_KNOWN = 1e4  # times the stiffest, or part of the softest, known Young's modulus
LARGEST_POISSON_RATIO = 0.4999  # that is computed with: beyond, displacements change by less than a part in a thousand of the strain


@dataclass(frozen=True, slots=True, eq=False)
class KnownZones:
    """Known zones: Young's modulus, kPa, and Poisson's ratio by name, their standard deviations, and whether moduli are only ratios."""

    values: Mapping[str, tuple[float, float]]
    doubts: Mapping[str, tuple[float, float]]
    relative: bool

    @property
    def not_rigid(self) -> tuple[str, ...]:
        """Names of the zones that are not called rigid."""
        return tuple(self.doubts)

    @property
    def rigid(self) -> tuple[str, ...]:
        """Names of the zones that are called rigid."""
        return tuple(name for name in self.values if name not in self.doubts)

    @property
    def bounds(self) -> Bounds:
        """Bounds of shear moduli, beyond which a zone cannot be told from one that is rigid, or empty."""
        known = [young for young, _ in self.values.values()] or [1.0]
        return Bounds(shear_modulus=(min(known) / BEYOND_KNOWN, max(known) * BEYOND_KNOWN))

    def zones(self, mesh: Mesh, *, each_cell: bool | Sequence[str] = False) -> Zones:
        """Return the zones of a mesh that has these regions; see `Zones.of`."""
        sd, rigid = self.doubts, self.rigid
        return Zones.of(mesh, known=self.values, known_sd=sd, each_cell=each_cell, relative=self.relative, rigid=rigid)

    def without(self, names: Collection[str]) -> KnownZones:
        """Return what is known of other zones than these."""
        values, doubts = ({k: v for k, v in given.items() if k not in names} for given in (self.values, self.doubts))
        return KnownZones(values, doubts, self.relative)


NOTHING_KNOWN = KnownZones({}, {}, relative=True)


def parse_known_zones(known: Sequence[str], names: Sequence[str]) -> KnownZones:
    """Read ``"gel=12 kPa"``, ``"gel=12 kPa, 0.45"``, ``"bone=rigid"`` or ``"gel"``.

    Raises
    ------
    InputError
        A text that is none of these, a zone that does not exist or is stated twice, or nothing that sets the scale.
    """
    values: dict[str, tuple[float, float]] = {}
    doubts: dict[str, tuple[float, float]] = {}
    rigid: list[str] = []
    relative = False
    for text in known:
        name, equals, value = (part.strip() for part in text.partition("="))
        if name not in names:
            raise InputError(f"known={text!r}: there is no zone {name!r}; the zones are {', '.join(map(repr, names))}")
        if name in values or name in rigid:
            raise InputError(f"known={text!r}: zone {name!r} is stated twice; state it once")
        if equals and value == "rigid":
            rigid.append(name)
        elif equals:
            values[name], doubts[name] = stated_moduli("known", text, value)
        else:
            relative, values[name], doubts[name] = True, (1.0, POISSON_RATIO), (0.0, POISSON_RATIO_SD)
    if not values:
        raise InputError(
            f"known names no zone with a modulus, so that nothing sets the scale; name one of {', '.join(map(repr, names))}, "
            "with its Young's modulus, or without it for ratios; a map of moduli (each_cell) needs none"
        )
    if relative and len(values) > 1:
        raise InputError("known states the modulus of some zones and leaves that of another open; state all, or name one")
    stiff = RIGID * max(young for young, _ in values.values())
    return KnownZones(values | dict.fromkeys(rigid, (stiff, 0.3)), doubts, relative)


def stated_moduli(argument: str, text: str, value: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return Young's modulus, kPa, and Poisson's ratio, and their standard deviations, of ``12 kPa`` or ``12 kPa, 0.45``.

    Ratios above `LARGEST_POISSON_RATIO`, up to 0.5, are computed with as that.

    Raises
    ------
    InputError
        Another text, in the words of an argument.
    """
    modulus, comma, ratio = (part.strip() for part in value.partition(","))
    try:
        young, poisson = kilopascals(modulus), float(ratio) if comma else POISSON_RATIO
    except ValueError as error:  # an InputError is one
        said = f" ({error})" if isinstance(error, InputError) else ""
        other = ", 'bone=rigid', or 'gel'" if argument == "known" else ""
        ways = f"write 'gel=12 kPa', 'gel=12 kPa, 0.45' with Poisson's ratio{other}"
        raise InputError(f"{argument}={text!r}: {ways}{said}") from error
    if not 0.0 <= poisson <= 0.5:
        raise InputError(f"{argument}={text!r}: Poisson's ratio must lie between 0 and 0.5, not {poisson:g}")
    return (young, min(poisson, LARGEST_POISSON_RATIO)), (0.0, 0.0 if comma else POISSON_RATIO_SD)
