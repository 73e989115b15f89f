"""A fingertip's file, read and checked: what is pressed, how, and what reads it."""

from __future__ import annotations

import hashlib
import math
import os
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from naibu.applications.fingertip.decoder import Training
from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import Press
from naibu.core.errors import InputError
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.reading import read_bytes
from naibu.io.study_schemas.fingertip_schema import FingertipFile, PressTable, load_fingertip
from naibu.workflows.applications.simulate_chip import CHIP, PreparedChip, prepared_chip

FINGERTIP = "fingertip"  # name of the study that naibu brings along
FINGERTIP_TITLE = "soft fingertip with a sensing chip, and forces decoded from it"
_KEYS = {
    "young_modulus_kpa": "[fingertip] young_modulus_kPa",
    "diameter_mm": "[fingertip] diameter_mm",
    "package_diameter_mm": "[fingertip] package_diameter_mm",
    "package_height_mm": "[fingertip] package_height_mm",
    "poisson_ratio": "[fingertip] poisson_ratio",
    "law": "[fingertip] law",
    "tilt_deg": "[[press]] tilt_deg with [jig] tilt_error_deg",
    "tilts_deg": "[decoder] tilts_deg",
}


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFingertip:
    """A fingertip's file, read and checked.

    Attributes
    ----------
    name, title, source, digest : str
        Of the files, heading, what was asked for, and SHA-256 of the file and of the chip's.
    settings : FingertipFile
        Contents.
    fingertip : Fingertip
        Dimensions and gel.
    resolution : FingertipResolution
        Of its mesh.
    presses : tuple of Press
        In the order of the file, with the errors of the jig.
    training : Training, optional
        Of the decoder, where there is one.
    chip : PreparedChip
        The chip.
    """

    name: str
    title: str
    source: str
    digest: str
    settings: FingertipFile
    fingertip: Fingertip
    resolution: FingertipResolution
    presses: tuple[Press, ...]
    training: Training | None
    chip: PreparedChip

    def named(self, k: int) -> str:
        """Return the name of a press."""
        return self.settings.press[k].name or f"press {k + 1}"

    def azimuth_deg(self, k: int) -> float:
        """Return the azimuth of a press, with the error of the jig, degrees."""
        table, jig = self.settings.press[k], self.settings.jig
        beyond = table.tilt_deg + jig.tilt_error_deg < 0.0  # a tilt to the other side
        return table.azimuth_deg + jig.azimuth_error_deg + (180.0 if beyond else 0.0)


def fingertip_text() -> str:
    """Return the file of the study that comes with naibu, which explains every key."""
    return (files("naibu") / "datasets" / "studies" / "fingertip.toml").read_text(encoding="utf-8")


def describes_fingertip(source: str | os.PathLike[str]) -> bool:
    """Whether a study is a fingertip: by its name, or a file that has a table ``[fingertip]``."""
    if os.fspath(source) == FINGERTIP:
        return True
    try:
        return "fingertip" in parsed_toml(source, read_bytes(Path(source)))
    except InputError:  # told by whoever reads it
        return False


def prepared_fingertip(source: str | os.PathLike[str]) -> PreparedFingertip:
    """Read and check a fingertip.

    Parameters
    ----------
    source : str or path-like
        ``"fingertip"``, or a file.

    Raises
    ------
    InputError
        No such file; a key or value that cannot be; a chip's file that cannot be used. The message names the file.
    """
    own = os.fspath(source) == FINGERTIP
    content = fingertip_text().encode() if own else read_bytes(Path(source))
    settings = load_fingertip(f"{FINGERTIP}.toml" if own else Path(source), content)
    told = os.fspath(source)
    if not settings.press:
        raise InputError(f"{told}: [[press]] is missing; add at least one")
    try:
        f = settings.fingertip
        fingertip = Fingertip(f.diameter_mm, f.young_modulus_kPa, f.poisson_ratio, f.law, f.package_diameter_mm, f.package_height_mm)
        mesh = settings.mesh
        resolution = FingertipResolution(mesh.around, mesh.upwards, mesh.shells)
        for table in settings.press:
            _require_bearable("[[press]] force_N", table.force_N, fingertip)
            if abs(table.slide_mm) > fingertip.diameter_mm:
                raise InputError(f"[[press]] slide_mm is {table.slide_mm:g}, more than the diameter of the fingertip; make it shorter")
        names = [table.name for table in settings.press if table.name]
        if len(set(names)) < len(names):
            raise InputError(f"two [[press]] tables have the name {max(names, key=names.count)!r}; rename one")
        if settings.decoder is not None:
            _require_bearable("[decoder] force_N", settings.decoder.force_N[1], fingertip)
        presses = tuple(_press(table, settings.jig.tilt_error_deg) for table in settings.press)
        training = _training(settings)
    except InputError as error:
        raise InputError(f"{told}: {in_keys(str(error))}") from error
    chip_file = settings.readings.chip_file
    chip = prepared_chip(Path(source).parent / chip_file if chip_file else CHIP)
    digest = hashlib.sha256(content + chip.digest.encode()).hexdigest()
    name = FINGERTIP if own else Path(source).stem
    return PreparedFingertip(
        name, settings.title or name, told, digest, settings, fingertip, resolution, presses, training, chip
    )  # fmt: skip


def _require_bearable(name: str, newtons: float, fingertip: Fingertip) -> None:
    """Refuse a force that would take a mean strain of one over the whole base."""
    most = 1e-3 * fingertip.young_modulus_kpa * math.pi * (0.5 * fingertip.diameter_mm) ** 2
    if newtons > most:
        raise InputError(
            f"{name} is {newtons:g}, more than {most:.3g} N, Young's modulus times the area of the base: the gel would be flattened; "
            "check the number and its unit"
        )


def _press(table: PressTable, tilt_error: float) -> Press:
    return Press(abs(table.tilt_deg + tilt_error), 1e3 * table.force_N, table.friction, table.slide_mm)


def _training(settings: FingertipFile) -> Training | None:
    d = settings.decoder
    if d is None:
        return None
    moduli, forces = d.young_modulus_kPa, d.force_N
    if not moduli[0] <= settings.fingertip.young_modulus_kPa <= moduli[1]:
        raise InputError(
            f"[decoder] young_modulus_kPa is {moduli}, without the fingertip's {settings.fingertip.young_modulus_kPa:g}; widen it"
        )
    return Training(tuple(d.tilts_deg), tuple(d.frictions), (moduli[0], moduli[1]), (1e3 * forces[0], 1e3 * forces[1]), d.model_error)


def in_keys(message: str) -> str:
    """Return a message about arguments as one about the keys of the file."""
    told = message
    for name, key in _KEYS.items():
        told = re.sub(rf"(?<![\w\]] )\b{name}\b", key, told)
    return re.sub(r"\bforce_mn is ([\d.e+]+)", lambda m: f"[[press]] force_N is {1e-3 * float(m.group(1)):g}", told)
