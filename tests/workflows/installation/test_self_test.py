"""The self-test of an installation passes where everything works, and fails where something does not."""

from __future__ import annotations

import math

import pytest

from naibu.core.errors import InputError
from naibu.workflows.installation import self_test as workflow
from naibu.workflows.installation.self_test import SelfCheck, self_test


@pytest.mark.slow
def test_everything_passes_here() -> None:
    checks = self_test()
    assert len(checks) == 7 and all(check.passed for check in checks), checks
    assert sum({check.name.split(":")[0]: check.seconds for check in checks}.values()) < 300.0


def test_wrong_results_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The block weighs more than the study says; the other two cases cannot be computed."""

    def broken(*_: object, **__: object) -> object:
        raise InputError("nothing works")

    monkeypatch.setattr(workflow, "sense", broken)
    monkeypatch.setattr(workflow, "identify", broken)
    monkeypatch.setattr(workflow, "STUDY", workflow.STUDY.replace("mass_g = 12.0", "mass_g = 12.1"))
    sensed, identified, simulated = self_test()
    assert not sensed.passed and sensed.trouble == identified.trouble == "nothing works" and math.isnan(sensed.found)
    assert not simulated.passed and simulated.found == pytest.approx(12.1 / 12.0, rel=1e-3) and not simulated.trouble


def test_bounds_hold_what_they_say() -> None:
    assert SelfCheck("a", 1.0, 0.0, 1.0, 0.1).passed
    assert not SelfCheck("a", math.nan, 0.0, 1.0, 0.1).passed and not SelfCheck("a", 1.1, 0.0, 1.0, 0.1).passed
