"""The identified gels that come with naibu were identified from the bundled data that they name."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from naibu.io.files.provenance import sha256

DATA = Path(str(files("naibu") / "datasets" / "data"))
MODEL = json.loads((DATA / "identified_gels.json").read_text(encoding="utf-8"))
INPUTS = [(folder, name, digest) for folder, tables in MODEL["provenance"]["inputs"].items() for name, digest in tables.items()]


@pytest.mark.parametrize(("folder", "name", "digest"), INPUTS)
def test_it_was_identified_from_the_data_that_are_bundled(folder: str, name: str, digest: str) -> None:
    assert sha256(DATA / folder / name) == digest


def test_its_parts_agree_with_its_provenance() -> None:
    stated = MODEL["provenance"]
    assert MODEL["settings"] == stated["settings"]
    assert {case.partition("/")[0] for case in MODEL["load_cases"]} == set(stated["inputs"])
    assert stated["known"] == [f"{name}={value:g} kPa" for name, value in MODEL["known"]["young_moduli"].items()]
    free = [p for p in MODEL["parameters"] if not p["fixed"]]
    covariance = np.array(MODEL["covariance"])
    assert covariance.shape == (len(free), len(free))
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
