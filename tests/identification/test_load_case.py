"""Load cases of all kinds are load cases: each has a name and counts its data."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.from_motion.rheology import MotionLoadCase
from naibu.identification.load_case import LoadCase, require_load_cases
from naibu.meshing.primitives import box
from naibu.validation.specimens.marker_phantoms import Scanner, two_gels, virtual_specimen


def field_case(name: str = "push") -> FieldLoadCase:
    mesh = box((10.0, 10.0, 10.0), (1, 1, 1), cell_type="tetra")
    valid = np.arange(mesh.n_points) > 1
    field = DisplacementField.from_arrays(mesh.points, np.ones_like(mesh.points), valid=valid)
    return FieldLoadCase.of(name, field, mesh, loaded=mesh.points[:, 2] < 1e-9)


def motion_case() -> MotionLoadCase:
    mesh = box((10.0, 10.0, 10.0), (1, 1, 1), cell_type="tetra")
    moved = np.zeros((3, 2, 3))
    moved[1, 0, 2] = np.nan
    return MotionLoadCase.of("motion", mesh, (), [0.0, 1.0, 2.0], mesh.points[:2], moved, sd_mm=0.1)


def marker_case() -> MarkerLoadCase:
    template, truth = two_gels(50.0)
    coarse = ModelSettings(contact="stick", element_size_mm=20.0)
    moduli = {name: value for name, value in truth.items() if "friction" not in name}
    seen = virtual_specimen(template, moduli, settings=coarse).scanned(seed=0, scanner=Scanner(missing=0.1)).experiment
    return MarkerLoadCase.of(specimen(seen, coarse), "pressed", NoiseModel())


def test_every_load_case_has_a_name_and_counts_its_data() -> None:
    markers = marker_case()
    cases: list[tuple[LoadCase, str, int]] = [
        (field_case(), "push", 3 * 6),
        (motion_case(), "motion", 2 * 2 * 3 - 1),  # at rest at the first time, which is no datum
        (markers, "virtual/pressed", int(np.isfinite(markers.measured).sum())),
    ]
    require_load_cases([case for case, _, _ in cases])
    for case, name, count in cases:
        assert (case.name, case.n_data) == (name, count)


def test_no_load_case_and_no_data_are_refused() -> None:
    with pytest.raises(InputError, match="load_cases is empty"):
        require_load_cases([])

    class Empty:
        name, n_data = "held", 0

    with pytest.raises(InputError, match="'held' has no measured component"):
        require_load_cases([field_case(), Empty()])
