"""Parameters of the elements of a study: as given, or from the moduli of the solid that the lattice stands for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.provenance import sha256
from naibu.io.files.reading import file_beside
from naibu.io.images import read_volume
from naibu.io.study_schemas.lattice_study_schema import StudyFile
from naibu.mechanics.lattices.model.elastic_springs import elastic_stiffness
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, lattice_parameters
from naibu.mechanics.lattices.model.voxels import cube_means
from naibu.workflows.studies.label_volume import label_volume


def element_parameters(path: Path, settings: StudyFile, lattice: Lattice) -> LatticeParameters:
    """Return K, C1 and C2 of all elements of the lattice of a study; `path` is that of its file.

    Raises
    ------
    InputError
        Parameters that do not fit the lattice, a volume of moduli that cannot be read, or cubes of the object without a modulus.
    """
    given, material = settings.parameters, settings.material
    place = "parameters" if material is None else "material"
    try:
        if material is None:
            assert given is not None  # one of the two, by the schema
            return lattice_parameters(lattice, given.K, given.C1, given.C2)
        stiffness = elastic_stiffness(lattice, _moduli(path, settings, lattice))
        return lattice_parameters(lattice, stiffness, material.retardation_s * stiffness, material.relaxation_s * stiffness)
    except InputError as error:
        raise InputError(f"{path}: [{place}] {error}") from error


def material_inputs(path: Path, settings: StudyFile) -> dict[str, str]:
    """Return name and SHA-256 of the volume of moduli, if there is one.

    Raises
    ------
    InputError
        The file is not there.
    """
    material = settings.material
    if material is None or not isinstance(material.young_modulus_kPa, str):
        return {}
    file = file_beside(path, material.young_modulus_kPa)
    return {file.name: sha256(file)}


def _moduli(path: Path, settings: StudyFile, lattice: Lattice) -> float | FloatArray:
    """Return Young's modulus, kPa: one number, or one of each cube."""
    assert settings.material is not None
    given, table = settings.material.young_modulus_kPa, settings.object
    if isinstance(given, float):
        return given
    volume = _modulus_volume(path, given) if isinstance(given, str) else _by_label(path, settings, given)
    found = cube_means(lattice, volume)
    if (lack := int(np.isnan(found).sum())) == 0:
        return found
    where = lattice.frame.applied(
        lattice.points[(lattice.cells if lattice.cells is not None else [])[int(np.argmax(np.isnan(found)))]].mean(axis=0)
    )
    source = f"young_modulus_kPa = {given!r}" if isinstance(given, str) else "young_modulus_kPa by label"
    raise InputError(
        f"{source} gives {lack} of {len(found)} cubes of the object no positive modulus, one of them at "
        f"({where[0]:.4g}, {where[1]:.4g}, {where[2]:.4g}) mm; choose labels ([object] label = {table.label}) that lie within the volume"
    )


def _modulus_volume(path: Path, name: str) -> Volume:
    volume = read_volume(file_beside(path, name), missing=True)  # a zone whose modulus was not determined
    values = np.asarray(volume.values, dtype=float)
    return volume.with_values(np.where(np.isfinite(values) & (values > 0.0), values, np.nan))


def _by_label(path: Path, settings: StudyFile, moduli: Mapping[str, float]) -> Volume:
    table = settings.object
    assert table.labels is not None  # by the schema
    labels = label_volume(path, file_beside(path, table.labels), table)
    present = {int(v) for v in np.unique(labels.values) if v}
    wanted = present if table.label is None else present & set(table.label)
    lack = sorted(wanted - {int(key) for key in moduli})
    if lack:
        raise InputError(f"young_modulus_kPa gives no modulus of label {', '.join(map(str, lack))} of {table.labels}; add it")
    values = np.full(labels.shape, np.nan)
    for key, modulus in moduli.items():
        if int(key) in wanted:
            values[labels.values == int(key)] = modulus
    return labels.with_values(values)
