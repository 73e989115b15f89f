"""Markers through several volumes: the same number is the same marker, and positions get better together."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from marker_scenes import lattice, render_spheres
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from naibu.core.errors import InputError
from naibu.core.experiment import Loading, Shape
from naibu.core.volume import Volume
from naibu.imaging.markers.joint_localization import joint_positions
from naibu.imaging.markers.tracking import TrackedMarkers, linked_states, track_markers
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.tables.marker_tables import write_experiment_folder

GRID = lattice((4, 4, 3), 5.0, 0.7, seed=2, start=4.5)
ORIGIN = np.array([7.0, -3.0, 11.0])
SHAPE = (42, 54, 54)


def pressed(x: np.ndarray, stretch: float) -> np.ndarray:
    wide = stretch**-0.5
    return np.asarray((x - (12.0, 12.0, 0.0)) * (wide, wide, stretch) + (13.0, 13.0, 1.0))


def scans(centres: list[np.ndarray]) -> list[Volume]:
    return [render_spheres(c, shape=SHAPE, contrast=-400.0, seed=s) for s, c in enumerate(centres)]


@pytest.fixture(scope="module")
def tracked() -> TrackedMarkers:
    states = [GRID, pressed(GRID, 0.85), np.delete(pressed(GRID, 0.7), 5, axis=0)]
    return track_markers(scans(states), diameter_mm=2.0, names=["free", "h30", "h25"])


def test_numbers_are_the_same_material_points(tracked: TrackedMarkers) -> None:
    first = tracked.points[0] - ORIGIN
    material = np.array([np.argmin(np.linalg.norm(GRID - p, axis=1)) for p in first])
    assert len(set(material)) == len(GRID) == len(tracked.ids)
    for s, stretch in enumerate((1.0, 0.85, 0.7)):
        truth = (GRID if s == 0 else pressed(GRID, stretch)) + ORIGIN
        error = np.linalg.norm(tracked.points[s] - truth[material], axis=1)
        assert np.nanmax(error) < 0.15
    gone = material == 5
    assert (tracked.flags[2] == np.where(gone, "missing", "ok")).all()
    assert np.isnan(tracked.points[2, gone]).all()
    assert np.isfinite(tracked.sd_mm[tracked.flags == "ok"]).all()
    assert tracked.found[2].polarity == "dark"


def test_the_result_is_an_experiment_folder(tracked: TrackedMarkers, tmp_path: Path) -> None:
    folder = write_experiment_folder(
        tmp_path / "gel",
        tracked.markers[0],
        tracked.states,
        title="Spheres",
        shape=Shape("box", (30.0, 30.0, 22.0)),
        loading=Loading("plate"),
        stated_mm={"h30": 18.7, "h25": 15.4},
    )
    back = read_experiment(folder)
    assert [state.name for state in back.states] == ["initial", "h30", "h25"]
    for state, markers in zip(back.states, tracked.markers, strict=True):
        assert state.markers is not None
        np.testing.assert_allclose(state.markers.points, markers.points, rtol=1e-11)
        assert (state.markers.ids == markers.ids).all()


def test_intermediate_states_bridge_a_turn_that_is_too_large_at_once() -> None:
    x = lattice((6, 5, 1), 5.0, 0.2, seed=3)[:, :2]
    angle = np.radians(28.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    states, orders, rng = [x], [np.arange(len(x))], np.random.default_rng(0)
    for _ in range(5):
        orders.append(rng.permutation(len(x)))
        states.append((states[-1][np.argsort(orders[-2])] @ turn.T)[orders[-1]])
    link, confidence, _ = linked_states(states)
    for s in range(1, 6):
        assert (orders[s][link[s]] == np.arange(len(x))).all()
    assert (confidence > 0.5).all()


def test_joint_positions_are_better_and_say_so() -> None:
    x = lattice((5, 5, 5), 10.0, 0.6)
    truth = np.stack([x, x * (1.12, 1.12, 0.8) + 0.002 * x[:, 2:] ** 2, x * (1.2, 1.2, 0.65) + 0.3 * np.sin(0.08 * x[:, [2, 0, 1]])])
    ratio, gains = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        hidden = rng.uniform(size=truth.shape[:2]) < 0.5
        sd = np.stack([np.full(hidden.shape, 0.03), np.full(hidden.shape, 0.03), np.where(hidden, 0.2, 0.04)], axis=2)
        measured = truth + sd * rng.standard_normal(truth.shape)
        better = joint_positions(measured, sd[..., None] ** 2 * np.eye(3))
        before, after = (np.sqrt(np.mean((p - truth)[:, :, 2] ** 2)) for p in (measured, better.points))
        gains.append(after / before)
        ratio.append((better.points - truth) / np.sqrt(np.einsum("snii->sni", better.covariance)))
        assert better.outliers.mean() < 0.01
    assert max(gains) < 0.75
    assert 0.8 < np.sqrt(np.mean(np.square(ratio))) < 1.25


@pytest.mark.parametrize(("noise", "seed"), [(5.0, 0), (20.0, 1), (60.0, 2)])
def test_the_stated_deviation_is_that_of_the_errors(noise: float, seed: int) -> None:
    states = [GRID, pressed(GRID, 0.85)]
    volumes = [render_spheres(c, shape=SHAPE, contrast=-400.0, noise=noise, seed=10 * seed + s) for s, c in enumerate(states)]
    found = track_markers(volumes, diameter_mm=2.0)
    material = cKDTree(GRID + ORIGIN).query(found.points[0])[1]
    error = found.points - np.stack([c[material] + ORIGIN for c in states])
    across, along = np.sqrt(np.mean(error[..., :2] ** 2)), np.sqrt(np.mean(error[..., 2] ** 2))
    ratio = np.array([across, along]) / found.typical_sd_mm
    assert (ratio > 1 / 1.5).all() and (ratio < 1.5).all(), ratio


def test_an_outlier_is_reported_and_not_updated() -> None:
    x = lattice((4, 4, 4), 10.0, 0.5)
    states = np.stack([x, x * (1.1, 1.1, 0.85)])
    states[1, 20] += (0.0, 3.0, 0.0)
    better = joint_positions(states, np.broadcast_to(1e-3 * np.eye(3), (2, 64, 3, 3)).copy())
    assert np.flatnonzero(better.outliers[1]).tolist() == [20]
    assert (better.points[1, 20] == states[1, 20]).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_volume_without_markers_has_none_that_are_trusted(seed: int) -> None:
    """A textured body without markers, before and after a shift by a voxel, of which every blob could be followed."""
    rng, shape = np.random.default_rng(seed), (32, 40, 40)
    z, y, x = np.indices(shape)
    inside = 1.0 / (1.0 + np.exp(15.0 * (np.sqrt(((x - 20) / 16) ** 2 + ((y - 20) / 15) ** 2 + ((z - 16) / 12) ** 2) - 1.0)))
    texture = gaussian_filter(rng.normal(size=shape), 1.5)
    body = 100.0 * inside * (1.0 + 0.2 * texture / texture.std())
    volumes = [Volume.from_array(np.roll(body, k, axis=2) + 2.0 * rng.normal(size=shape), spacing_mm=(1.0, 1.0, 1.0)) for k in range(2)]
    for diameter in (3.0, 6.0):
        try:
            found = track_markers(volumes, diameter_mm=diameter)
        except InputError as error:
            assert re.search("no bright or dark marker|are needed|no common structure", str(error))
        else:
            assert not (found.flags[1:] == "ok").any()


def test_few_markers_are_trusted_only_where_their_number_is_known() -> None:
    some = GRID[[0, 15, 21, 47]]
    volumes = scans([some, pressed(some, 0.85)])
    assert (track_markers(volumes, diameter_mm=2.0).flags[1] == "suspect").all()
    assert (track_markers(volumes, diameter_mm=2.0, count=4).flags[1] == "ok").all()


def test_what_cannot_be_followed_is_refused() -> None:
    volumes = scans([GRID, pressed(GRID, 0.85)])
    for arguments, words in (
        ({"volumes": volumes[:1]}, "volumes must be at least two"),
        ({"volumes": volumes, "min_confidence": 1.5}, "min_confidence must lie between 0 and 1, not 1.5"),
        ({"volumes": volumes, "names": ["a"]}, "names has 1 entries for 2"),
        ({"volumes": volumes, "names": ["a", "a"]}, "names must differ"),
        ({"volumes": volumes, "masks": [None]}, "masks has 1"),
        ({"volumes": [volumes[0], render_spheres(np.zeros((0, 3)), shape=SHAPE)]}, "state 'state_1': no dark marker"),
        ({"volumes": [volumes[0], render_spheres(GRID[:2], shape=SHAPE, contrast=-400.0)]}, "only 2 markers were found"),
    ):
        with pytest.raises(InputError, match=words):
            track_markers(diameter_mm=2.0, **arguments)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="'initial'"):
        linked_states([rng.uniform(size=(40, 3)), rng.uniform(size=(45, 3))])
