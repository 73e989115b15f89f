"""Fields whose vectors are in another frame than their positions are refused before a search, with what mends them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from naibu.cli import main
from naibu.core.displacement_field import DisplacementField
from naibu.core.progress import ProgressReport
from naibu.core.volume import Volume
from naibu.identification.from_fields.assumptions.component_order import LikelierOrder
from naibu.identification.from_fields.assumptions.volume_change import VolumeChange
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import QuadraticBody
from naibu.workflows.fields import identify_fields as identify_module
from naibu.workflows.fields.identify_fields import identify_fields
from naibu.workflows.fields.likely_components import require_likely_components, told_doubt, told_order

SD_MM = 0.04
SIDES = ("z-", "z+")


class Searching(Exception):
    """Raised where a search would begin."""


def stop_at_search(report: ProgressReport) -> None:
    if report.stage.startswith("finding how the loaded nodes move"):
        raise Searching


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A cube of two gels, labels 1 below and 2 above, and its field with z pointing down in the displacements alone."""
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[2:12, 2:22, 2:22], labels[12:22, 2:22, 2:22] = 1, 2
    volume = Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(100.0, 50.0, 20.0))
    write_volume(tmp_path / "labels.mha", volume)
    rng = np.random.default_rng(0)
    points, u = QuadraticBody("cube").solved((1.0, 0.5, -4.0), divisions=4).at(rng.uniform(0.02, 0.98, (1500, 3)))
    u = u + SD_MM * rng.standard_normal(u.shape)
    points = points + volume.to_physical(np.array([1.5, 1.5, 1.5]))
    for name, signs in (("right", (1.0, 1.0, 1.0)), ("wrong", (1.0, 1.0, -1.0))):
        write_field(tmp_path / f"{name}.h5", DisplacementField.from_arrays(points, u * signs, sd_mm=SD_MM))
    return tmp_path


def test_a_wrong_sign_ends_before_the_search_and_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--zones", str(folder / "labels.mha"), "-k", "label 2=10 kPa", "--loaded", "z-", "--loaded", "z+", "-o", str(folder / "out")]
    monkeypatch.setattr(sys, "argv", ["naibu", "identify", str(folder / "wrong.h5"), *asked])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "change the sign of uz, or else of ux and uy" in told
    assert "no-check-components" in told
    assert not (folder / "out").exists()


@pytest.mark.parametrize(("name", "options"), [("right", {}), ("wrong", {"check_components": False})])
@pytest.mark.parametrize("each_cell", [False, True])
def test_right_fields_and_those_that_are_said_to_be_right_are_searched(
    folder: Path, name: str, options: dict[str, bool], *, each_cell: bool
) -> None:
    with pytest.raises(Searching):
        identify_fields(
            folder / f"{name}.h5", zones=folder / "labels.mha", known=["label 2=10 kPa"], loaded=SIDES, each_cell=each_cell,
            progress=stop_at_search, **options,  # type: ignore[arg-type]
        )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "options", "doubtful"),
    [("right", {}, False), ("wrong", {}, True), ("wrong", {"known": ["label 2=10 kPa, 0.1"]}, False)],
    ids=["right", "wrong", "a sponge"],
)
@pytest.mark.parametrize("each_cell", [False, True])
def test_a_wrong_sign_is_a_doubt_where_forces_may_act_anywhere(
    folder: Path, name: str, options: dict[str, object], monkeypatch: pytest.MonkeyPatch, *, doubtful: bool, each_cell: bool
) -> None:
    """A lung that expands in three directions looks alike, so that the field is searched."""
    found = []

    def noted(*given: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
        found.append(require_likely_components(*given))
        return found[-1]

    monkeypatch.setattr(identify_module, "require_likely_components", noted)
    with pytest.raises(Searching):
        identify_fields(
            folder / f"{name}.h5", zones=folder / "labels.mha", progress=stop_at_search, each_cell=each_cell,
            **{"known": ["label 2=10 kPa"], **options},  # type: ignore[arg-type]
        )  # fmt: skip
    doubts, _ = found[0]
    assert len(doubts) == doubtful
    assert not doubtful or "change the sign of uz, or else of ux and uy" in doubts[0]


def test_another_order_of_what_may_be_a_sponge_is_a_doubt() -> None:
    told = told_doubt(VolumeChange(0.71, 0.5, 0.12, 0.71, 1, np.eye(3)[[2, 1, 0]]))
    assert "changes 0.71 times as much as the shape" in told and "0.12 times" in told
    assert "take uz, uy, ux for ux, uy, uz" in told


def test_another_order_is_told_with_the_columns_to_take() -> None:
    order = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    told = told_order(LikelierOrder(0.42, 0.123, (order,)))
    assert "42 % of the deformation unexplained" in told
    assert "would leave 12 %" in told
    assert "take ux, -uz, uy for ux, uy, uz, or else -ux, uz, -uy" in told
