"""Named studies as files."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.workflows.studies.simulate_study import simulate_study


def test_a_study_is_written_for_paraview_for_a_browser_and_as_numbers(tmp_path) -> None:
    page, series, numbers = simulate_study("agar-block", tmp_path)
    assert "agar block" in page.read_text(encoding="utf-8")
    told = json.loads(numbers.read_text(encoding="utf-8"))
    with h5py.File(series) as file:
        root = file["VTKHDF"]
        assert root["Steps/Values"][:].tolist() == told["times_s"]
        last = root["PointData/displacement_mm"][:].reshape(len(told["times_s"]), -1, 3)[-1]
    assert last[:, 1].min() == pytest.approx(-7.5)
    assert np.asarray(told["middle_of_the_pushed_face_mm"])[-1] == pytest.approx([0.0, -7.5], abs=1e-9)
    # the weight presses down, the floor holds up, and what is left of inertia is little
    assert told["forces_mN"]["weight"][-1][1] < 0.0
    assert told["forces_mN"]["floor"][-1][1] == pytest.approx(-told["forces_mN"]["weight"][-1][1], rel=1e-3)


def test_an_unknown_study_is_told_and_nothing_is_written(tmp_path) -> None:
    with pytest.raises(InputError, match="elastic-square"):
        simulate_study("square", tmp_path / "out")
    assert not (tmp_path / "out").exists()
