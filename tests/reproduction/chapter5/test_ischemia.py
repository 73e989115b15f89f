"""Chapter 5: what its page says of active ischemia, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.reproduction.chapter5 import ischemia
from naibu.reproduction.chapter5.ischemia import JET_RADIUS_MM, SAME


def test_time_constants_depend_on_viscosity_and_not_on_the_duration() -> None:
    modes = ischemia.modes_of("plane_strain", JET_RADIUS_MM, across=6, upwards=4)
    constants: dict[str, list[float]] = {}
    for what, value, found in ischemia.parameter_study(modes):
        assert found.measured.rise_constant_s == pytest.approx(found.measured.fall_constant_s, rel=1e-3)
        constants.setdefault(what, []).append(found.measured.fall_constant_s)
        if what == "C1, Pa s":
            assert found.measured.fall_constant_s == pytest.approx(1e-3 * float(value) / 3.8, rel=1e-3)
    assert np.ptp(constants["duration, s"]) < 1e-5 and np.ptp(constants["C2, kPa s"]) < 1e-5


def test_the_printed_grid_locks_and_keeps_the_time_constant() -> None:
    material = SAME["C1 = 30 Pa s"]
    triangles = ischemia.printed_grid("", material, material, step_s=2e-3)
    bricks = ischemia.response("", ischemia.printed_grid_modes(), material, material, 0.0)
    assert triangles.indentation.max() < 0.3 * bricks.indentation.max()
    assert triangles.measured.fall_constant_s == pytest.approx(material.retardation_time, rel=0.05)
    # the residual is the flow: the stress over the duration by C2, as large a share of the elastic indentation in both
    flow = material.young_modulus * ischemia.DURATION_S / material.series_viscosity
    for found in (triangles, bricks):
        elastic = found.measured.peak - found.measured.residual
        assert found.measured.residual / elastic == pytest.approx(flow, rel=0.01)


def test_time_and_frequency_domain_agree() -> None:
    modes = ischemia.modes_of("plane_strain", JET_RADIUS_MM, across=6, upwards=4)
    material = SAME["C1 = 30 Pa s"]
    for hertz in (1.0, 10.0):
        direct = ischemia.bode(modes, material, material, np.array([hertz]))[0]
        assert abs(ischemia.frequency_from_time(modes, material, hertz) / direct - 1.0) < 5e-3
