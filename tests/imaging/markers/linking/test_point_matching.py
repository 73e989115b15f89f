"""Links between two states: particles and lattices whose partners are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_scenes import Cloud, lattice, particle_cloud
from particle_gels import particle_gel

from naibu import datasets
from naibu.core.errors import InputError
from naibu.imaging.markers.linking.point_matching import link_markers
from naibu.imaging.markers.settings import LinkSettings


def judged(cloud: Cloud) -> tuple[float, float]:
    """Return the fraction of possible links that are right, and the fraction of links that are wrong."""
    right, possible, wrong = cloud.judged(link_markers(cloud.reference, cloud.deformed).pairs)
    return right / possible, wrong / max(right + wrong, 1)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("stretch", [0.85, 0.65])
def test_particles_are_linked_over_several_spacings(dimensions: int, stretch: float) -> None:
    cloud = particle_cloud(3000, 1, dimensions=dimensions, stretch=stretch)
    assert np.median(cloud.displacement) > 2.0
    right, wrong = judged(cloud)
    assert right > 0.97
    assert wrong < 0.015


def test_a_few_hundred_particles_are_linked_as_well() -> None:
    right, wrong = judged(particle_cloud(300, 4, waviness=0.2))
    assert right > 0.96
    assert wrong < 0.03


@pytest.mark.parametrize("seed", range(2))
def test_particles_in_a_gel_of_which_half_are_lost_with_depth(seed: int) -> None:
    """Noise that differs between axes and rises with depth, and one false particle for ten true ones."""
    cloud = particle_gel(6000, seed, loss=0.5)
    links = link_markers(cloud.reference, cloud.deformed)
    right, possible, wrong = cloud.judged(links.pairs)
    assert right > 0.99 * possible
    assert wrong < 0.01 * len(links)
    assert links.confidence.mean() < right / len(links) + 0.005


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_35000_particles_of_which_a_tenth_vanish(seed: int) -> None:
    right, wrong = judged(particle_cloud(35_000, seed, vanish=0.1, appear=0.1))
    assert right > 0.99
    assert wrong < 0.01


def test_a_lattice_pressed_to_less_than_two_thirds_is_linked_row_by_row() -> None:
    x = lattice((5, 5, 5), 10.0, 0.6)
    centre = x.mean(axis=0)
    y = (x - centre) * (1.3, 1.3, 0.58)
    y += 0.004 * np.column_stack([y[:, 0] * np.abs(y[:, 2]), y[:, 1] * np.abs(y[:, 2]), np.zeros(len(y))])
    order = np.random.default_rng(3).permutation(len(x))
    links = link_markers(x, y[order])
    assert len(links) == len(x)
    assert (order[links.pairs[:, 1]] == links.pairs[:, 0]).all()
    assert links.confidence.min() > 0.5


@given(st.integers(0, 10_000), st.floats(-180.0, 180.0), st.floats(0.2, 50.0))
@settings(max_examples=8, deadline=None)
def test_links_do_not_depend_on_the_order_of_markers_or_on_the_unit(seed: int, shift: float, unit: float) -> None:
    rng = np.random.default_rng(seed)
    x = lattice((4, 4, 3), 8.0, 1.5, seed=seed)
    y = x @ np.diag([1.1, 1.05, 0.85]) + (shift, 0.3 * shift, 2.0)
    order = rng.permutation(len(x))
    links = link_markers(unit * x, unit * y[order])
    assert (order[links.pairs[:, 1]] == links.pairs[:, 0]).all()
    assert len(links) == len(x)


def test_no_marker_is_used_twice_and_unmatched_ones_stay_alone() -> None:
    cloud = particle_cloud(2000, 7, vanish=0.2, appear=0.2)
    links = link_markers(cloud.reference, cloud.deformed)
    assert len(set(links.pairs[:, 0])) == len(set(links.pairs[:, 1])) == len(links)
    everything = np.sort(np.concatenate([links.pairs[:, 1], links.unmatched_deformed]))
    assert (everything == np.arange(len(cloud.deformed))).all()
    assert len(links.unmatched_reference) == len(cloud.reference) - len(links)
    wrong = cloud.truth[links.pairs[:, 0]] != links.pairs[:, 1]
    assert links.confidence[wrong].mean() < links.confidence[~wrong].mean()


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("ct_cube_plate", "height_35"),
        ("ct_two_material_3", "deformed"),
        ("ct_test_piece", "deformed"),
        ("mr_agar", "deformed"),
        ("us_agar", "trial1_deformed"),
        ("us_agar", "trial2_deformed"),
    ],
)
def test_measured_washers_are_linked_as_the_report_numbers_them(name: str, state: str) -> None:
    experiment = datasets.load(name)
    markers = experiment.state(state).markers
    assert markers is not None
    seen = slice(0, experiment.dimensions)
    here, there = (np.isfinite(m.points[:, seen]).all(axis=1) for m in (experiment.initial, markers))
    order = np.random.default_rng(0).permutation(int(there.sum()))
    ids = markers.ids[there][order]
    links = link_markers(experiment.initial.points[here][:, seen], markers.points[there][order][:, seen])
    assert (ids[links.pairs[:, 1]] == experiment.initial.ids[here][links.pairs[:, 0]]).all()
    assert len(links) == len(np.intersect1d(ids, experiment.initial.ids[here]))


def test_clouds_that_cannot_be_linked_are_refused() -> None:
    points = np.random.default_rng(0).uniform(size=(20, 3))
    for a, b, words in (
        (points[:2], points, "reference_points has 2 rows; at least 3 are needed"),
        (points, points[:, :2], "same dimension"),
        (points[:, :1], points, "shape"),
        (np.where(np.arange(20)[:, None] == 3, np.nan, points), points, r"reference_points\[3, 0\] is nan"),
        (np.ones((5, 3)), points, "no structure"),
    ):
        with pytest.raises(InputError, match=words):
            link_markers(a, b)
    with pytest.raises(InputError, match="predicted"):
        link_markers(points, points, predicted=points[:3])


@pytest.mark.parametrize("n", [20, 100, 300, 900])
def test_unrelated_clouds_are_not_linked(n: int) -> None:
    rng = np.random.default_rng(n)
    with pytest.raises(InputError, match="no common structure"):
        link_markers(rng.uniform(size=(n, 3)), rng.uniform(size=(n, 3)))


def test_both_ways_of_linking_find_the_same_links() -> None:
    cloud = particle_cloud(300, 4, waviness=0.1, vanish=0.0, appear=0.0)
    whole, grown = (link_markers(cloud.reference, cloud.deformed, settings=LinkSettings(assign_up_to=n)) for n in (600, 0))
    for links in (whole, grown):
        right, possible, _ = cloud.judged(links.pairs)
        assert right > 0.97 * possible


def test_limits_of_the_residual_decide_which_links_are_kept() -> None:
    cloud = particle_cloud(900, 2, noise=0.08)
    kept = [len(link_markers(cloud.reference, cloud.deformed, settings=LinkSettings(residual_factor=f))) for f in (1.5, 4.5)]
    assert kept[0] < 0.95 * kept[1]
    cloud = particle_cloud(900, 2, noise=0.04)
    everything = link_markers(cloud.reference, cloud.deformed)
    links = link_markers(cloud.reference, cloud.deformed, settings=LinkSettings(residual_bounds=(0.0, 0.2)))
    assert links.residual_mm.max() < 0.2 < everything.residual_mm.max()  # points are about one spacing apart


def test_link_settings_out_of_range_are_refused() -> None:
    for arguments, words in (
        ({"assign_up_to": -1}, "assign_up_to must lie between 0 and infinity"),
        ({"min_agreement": 1.2}, "min_agreement must lie between 0 and 1"),
        ({"min_mean_confidence": -0.1}, "min_mean_confidence must lie"),
        ({"residual_factor": 0.0}, "residual_factor must be positive"),
        ({"spline_residual_factor": np.nan}, "spline_residual_factor must be positive"),
        ({"residual_bounds": (0.8, 0.15)}, "residual_bounds must be two increasing numbers"),
        ({"spline_residual_bounds": (0.1,)}, "spline_residual_bounds must be two"),
        ({"search_radii": ()}, "search_radii must be increasing"),
        ({"search_radii": (4.0, 2.0)}, "search_radii must be increasing"),
    ):
        with pytest.raises(InputError, match=words):
            LinkSettings(**arguments)  # type: ignore[arg-type]
