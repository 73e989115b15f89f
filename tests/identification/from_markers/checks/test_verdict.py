"""The verdict, from residuals of which it is known what they are."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.status import Status
from naibu.identification.from_markers.checks.marker_checks import Doubt
from naibu.identification.from_markers.checks.marker_outliers import Outlier
from naibu.identification.from_markers.checks.verdict import CaseEvidence, prior_deviations, verdict
from naibu.identification.verdict import Explanation, Verdict

SD = 0.2
LATTICE = np.array(list(product(*[np.linspace(-20.0, 20.0, 5)] * 3))) + np.array([0.0, 0.0, 30.0])


def case(noise: float = 1.0, shared: float = 0.0, seed: int = 0, **changes: object) -> CaseEvidence:
    """Noise of so many stated standard deviations, and a smooth residual of so many mm that is largest at the top."""
    rng = np.random.default_rng(seed)
    residual = noise * SD * rng.normal(size=LATTICE.shape)
    residual[:, 0] += shared * ((LATTICE[:, 2] - 10.0) / 40.0) ** 2
    made = CaseEvidence("box/pressed", LATTICE, residual, np.full(LATTICE.shape, SD), 6.0, 1.5, 60.0, 45.0, 45.8)
    return replace(made, **changes)  # type: ignore[arg-type]


def judged(*cases: CaseEvidence, status: Status = Status.CONVERGED, **evidence: object) -> Verdict:
    data = np.concatenate([c.residual / c.sd for c in cases])
    options: dict[str, object] = {"deviations": {}} | evidence
    return verdict(cases, noise_factor=float(np.sqrt((data**2).mean())), status=status, **options)  # type: ignore[arg-type]


def test_noise_alone_is_explained() -> None:
    for seed in range(20):
        found = judged(case(seed=seed), case(seed=100 + seed))
        assert found.explanation is Explanation.EXPLAINED and found.reasons == () and found.notes == ()
        assert found.sentence.startswith("Explained: residuals of 0.3") and "94 % of the deformation" in found.sentence


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shared": 3.0, "affine_mm": 1.0}, "no less than an affine map leaves (1 mm)"),
        ({"noise": 20.0, "affine_mm": 9.0}, "of its deformation"),
        ({"expected_mm": 45.0, "found_mm": 8.0}, "stated at 45 mm but found at 8.0 mm"),
        ({"shared": 12.0, "affine_mm": 9.0}, "of its deformation"),
    ],
)
def test_what_the_model_does_not_explain_is_not_to_be_used(changes: dict[str, float], words: str) -> None:
    found = judged(case(), case(**changes, name="box/more"))  # type: ignore[arg-type]
    assert found.explanation is Explanation.NOT_EXPLAINED
    assert found.sentence.startswith("Not explained, do not use: box/more") and words in found.sentence


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise": 3.0, "affine_mm": 3.0}, "3.0 times the noise"),
        ({"noise": 3.0, "affine_mm": 1.0}, "neighbours do not share"),
        ({"shared": 1.9}, "near its top along x"),
        ({"expected_mm": 45.0, "found_mm": 36.0}, "found at 36.0 mm"),
        ({"noise": 1.5, "affine_mm": 0.2}, "although an affine map leaves only 0.2 mm"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(changes: dict[str, float], words: str) -> None:
    found = judged(case(), case(**changes, name="box/more"))  # type: ignore[arg-type]
    assert found.explanation is Explanation.IN_PART and "box/more" in found.sentence and words in found.sentence


def test_noise_that_is_overstated_is_said_and_hides_no_shared_residual() -> None:
    found = judged(case(noise=0.18))
    assert found.explanation is Explanation.EXPLAINED and "overstated about 6-fold" in found.notes[0]
    hidden = case(noise=0.18, sd=np.full(LATTICE.shape, 5 * SD), shared=1.8)
    assert hidden.noise_factor < 1.0
    assert judged(hidden).explanation is Explanation.IN_PART


def test_neighbours_share_what_is_not_noise() -> None:
    assert case().shared_mm < 0.1 < 0.9 * case().rms_mm
    smooth = case(noise=0.0, shared=1.0)
    assert smooth.shared_mm == pytest.approx(smooth.rms_mm, rel=0.15)
    both = case(noise=3.0, shared=1.0)
    assert both.shared_mm == pytest.approx(smooth.shared_mm, rel=0.35)


@pytest.mark.parametrize(
    ("off_mm", "explanation"), [(0.0, Explanation.EXPLAINED), (0.45, Explanation.EXPLAINED), (1.2, Explanation.IN_PART)]
)
def test_where_neighbours_are_off_together_is_said(off_mm: float, explanation: Explanation) -> None:
    """A corner of eight markers of 125, within the noise of the whole state."""
    plain = case()
    corner = np.all(LATTICE - [0.0, 0.0, 30.0] < -9.0, axis=1)
    residual = plain.residual + off_mm * corner[:, None] * [0.0, 0.0, 1.0]
    made = replace(plain, residual=residual)
    found = judged(made)
    assert corner.sum() == 8 and made.noise_factor < 2.0 and found.explanation is explanation
    told = " ".join((*found.reasons, *found.notes))
    place = re.search(r"around \((.*), (.*), (.*)\) mm are off by .* mm along z together", told)
    assert (place is not None) == (off_mm > 0.0)
    if place is not None:
        np.testing.assert_allclose([float(v) for v in place.groups()], [-15.0, -15.0, 15.0], atol=2.0)


def test_a_uniform_deformation_is_explained_but_tells_little() -> None:
    found = judged(case(affine_mm=0.33))
    assert found.explanation is Explanation.EXPLAINED and "tells little about materials" in found.notes[0]


def test_a_stated_height_that_the_markers_contradict_somewhat_is_noted() -> None:
    """A plate at 48 mm that was written down as at 41 mm, of 60 mm; and one that is off by no more than the noise."""
    found = judged(case(), case(expected_mm=41.0, found_mm=48.1, name="box/more"))  # type: ignore[arg-type]
    assert found.explanation is Explanation.EXPLAINED
    assert len(found.notes) == 1 and "box/more is stated at 41 mm, but the markers put it at 48.1 mm" in found.notes[0]
    assert judged(case(expected_mm=57.0, found_mm=56.5)).notes == ()  # type: ignore[arg-type]


def test_estimates_far_from_what_was_known_count() -> None:
    found = judged(case(), deviations={"box: base_offset": -3.7, "a: friction": 2.9})
    assert found.explanation is Explanation.EXPLAINED and "base_offset lies 3.7 standard deviations" in " ".join(found.notes)
    assert "friction" not in " ".join(found.notes)
    assert judged(case(), deviations={"box: base_offset": -6.0}).explanation is Explanation.IN_PART
    found = judged(case(), deviations={"a: friction": 0.1, "box: base_offset": 14.0})
    assert found.explanation is Explanation.NOT_EXPLAINED and "box: base_offset lies 14 standard deviations" in found.sentence


def test_deviations_are_counted_on_the_optimisers_scale() -> None:
    priors = ParameterSet.of(
        [Parameter("e", 200.0, "kPa", "log", prior_sd=2.0), Parameter("h", 45.0, "mm"), Parameter("k", 1.0, fixed=True)]
    )
    found = priors.with_values({"e": 200.0 * np.exp(3.0), "h": 12.0})
    assert prior_deviations(found, priors) == pytest.approx({"e": 1.5})


def test_doubts_outliers_and_an_early_end_are_told() -> None:
    assert judged(case(), doubts=[Doubt("z seems reversed")]).explanation is Explanation.IN_PART
    both = judged(case(), doubts=[Doubt("odd"), Doubt("z seems reversed", grave=True)])
    assert both.explanation is Explanation.NOT_EXPLAINED and both.reasons == ("z seems reversed", "odd")
    for status in (Status.ITERATION_LIMIT, Status.INTERRUPTED):
        assert judged(case(), status=status).explanation is Explanation.IN_PART
    found = judged(case(noise=0.5), outliers=[Outlier("box", "pressed", 60, "x", 16.04)])
    assert found.explanation is Explanation.EXPLAINED
    assert found.outliers == ("Marker 60 of box/pressed is 16 mm off along x: left out; 0.17 mm RMS remain without it.",)


def test_a_state_without_a_complete_marker_is_not_explained() -> None:
    nothing = case(points=LATTICE[:0], residual=LATTICE[:0], sd=LATTICE[:0])  # type: ignore[arg-type]
    assert judged(nothing, case()).explanation is Explanation.NOT_EXPLAINED
