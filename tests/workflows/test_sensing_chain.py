"""From virtual scans to a prediction, on known truth: scan, find and link markers, identify, predict a state that was not used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from naibu.core.experiment import Loading
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.baselines import affine
from naibu.identification.prediction.prediction import Prediction
from naibu.imaging.markers.tracking import TrackedMarkers, track_markers
from naibu.io.tables.marker_tables import write_experiment_folder
from naibu.validation.scanners.ct_mr import STEEL_WASHER, VirtualScan
from naibu.validation.scanners.experiments import scanned_states
from naibu.validation.specimens.marker_phantoms import VirtualSpecimen, box_experiment, virtual_specimen
from naibu.workflows import predict
from naibu.workflows.markers import identify

TRUTH = {
    "soft: young_modulus": 100.0,
    "firm: young_modulus": 200.0,
    "soft: poisson_ratio": 0.47,
    "firm: poisson_ratio": 0.47,
    "soft on table: friction": 0.35,
    "firm on acrylic: friction": 0.35,
}


@dataclass(frozen=True)
class Chain:
    specimen: VirtualSpecimen
    scans: dict[str, VirtualScan]
    tracked: TrackedMarkers
    found: identify.Identification
    unseen: Prediction

    def placing_errors(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return how far tracked markers of a state are from the nearest true ones, mm, and the labels of these."""
        truth = self.scans[name].markers
        distance, index = cKDTree(truth.points).query(np.nan_to_num(self.tracked.markers[self.tracked.names.index(name)].points, nan=1e6))
        return distance, truth.ids[np.minimum(index, len(truth.ids) - 1)]


def chain(folder: Path, side: float, apart: float, made_mm: float, sought_mm: float, spacing: tuple[float, float, float]) -> Chain:
    """Make, scan, track, identify from the first pressed state and predict the second; the meshes of truth and model differ."""
    platen_positions = {"pressed": 0.87 * side, "pressed_more": 0.8 * side}
    layers = [("soft", side / 2), ("firm", side / 2)]
    template = box_experiment("press", (side,) * 3, layers, Loading("plate"), platen_positions, spacing_mm=apart, margin_mm=apart)
    specimen = virtual_specimen(template, TRUTH, settings=ModelSettings(element_size_mm=made_mm), jitter_mm=0.3, seed=3)
    scans = scanned_states(specimen, spacing_mm=spacing, seed=5)
    volumes = [scan.volume for scan in scans.values()]
    tracked = track_markers(
        volumes, diameter_mm=STEEL_WASHER.diameter_mm, thickness_mm=STEEL_WASHER.thickness_mm, names=list(scans), polarity="bright"
    )
    described = specimen.experiment
    xy_sd, z_sd = tracked.typical_sd_mm
    write_experiment_folder(
        folder / "press",
        tracked.markers[0],
        tracked.states,
        title="A virtual press, scanned",
        shape=described.shape,
        loading=described.loading,
        layers=described.layers,
        stated_mm=platen_positions,
        spacing_mm=described.nominal_spacing_mm,
        xy_sd_mm=xy_sd,
        z_sd_mm=z_sd,
    )
    settings = ModelSettings(element_size_mm=sought_mm)
    found = identify.identify(folder / "press", known=["firm=200 kPa"], settings=settings, states={"press": ["pressed"]})
    unseen = predict.predict(found.model, folder / "press", state="pressed_more", heights_from_markers=True)
    return Chain(specimen, scans, tracked, found, unseen)


def judge(made: Chain, *, placing_mm: float, modulus: float, missed_mm: float) -> None:
    """Judge every link of a chain against the truth."""
    labels = []
    for name in made.scans:
        distance, ids = made.placing_errors(name)
        assert np.median(distance) < placing_mm, f"{name}: {np.median(distance):.3f} mm"
        labels.append(np.where(distance < 1.0, ids, -1))
    assert all((ids > 0).all() and len(set(ids.tolist())) == len(made.specimen.free) for ids in labels)
    for later in labels[1:]:
        np.testing.assert_array_equal(later, labels[0])
    parameter = made.found.model.parameters.free[0]
    assert parameter.name == "soft: young_modulus"
    low, high = made.found.model.interval(parameter.name)
    assert low < TRUTH[parameter.name] < high
    assert parameter.value == pytest.approx(TRUTH[parameter.name], rel=modulus)
    # the prediction against where markers truly are, relative to each other: in the pose in which they were seen
    missed = np.linalg.norm(made.unseen.residual, axis=1)
    assert np.sqrt(np.nanmean(missed**2)) < missed_mm
    measured = made.unseen.measured_in_object
    simple = np.linalg.norm(affine(made.unseen.specimen.marker_points, measured) - measured, axis=1)
    assert np.sqrt(np.nanmean(missed**2)) < 0.7 * np.sqrt(np.nanmean(simple**2))


def test_the_chain_closes_on_a_small_block(tmp_path: Path) -> None:
    made = chain(tmp_path, 40.0, 8.0, 6.7, 10.0, (0.7, 0.7, 0.7))
    judge(made, placing_mm=0.06, modulus=0.15, missed_mm=0.2)


@pytest.mark.slow
def test_the_chain_closes_on_a_block_of_125_markers(tmp_path: Path) -> None:
    made = chain(tmp_path, 60.0, 10.0, 6.0, 8.6, (0.58, 0.58, 0.8))
    judge(made, placing_mm=0.1, modulus=0.1, missed_mm=0.2)
