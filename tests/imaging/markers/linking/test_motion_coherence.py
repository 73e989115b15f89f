"""The motion of one body is told from labels that do not correspond, mirror images and other units."""

from __future__ import annotations

import numpy as np
import pytest
from marker_scenes import lattice, particle_cloud

from naibu import datasets
from naibu.core.errors import InputError
from naibu.imaging.markers.linking.motion_coherence import motion_coherence, require_coherent, strays_named
from naibu.imaging.markers.linking.point_matching import link_markers


def measured() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Every bundled state with enough markers, by its name, before and after."""
    found = []
    for name in datasets.names():
        experiment = datasets.load(name)
        for state in experiment.states[1:]:
            if state.markers is not None:
                before, after = experiment.initial.points, state.markers.aligned(experiment.initial.ids)
                known = np.isfinite(before[:, : experiment.dimensions] + after[:, : experiment.dimensions]).all(axis=1)
                if known.sum() >= 8 and experiment.dimensions == 3:
                    found.append((f"{name}/{state.name}", before[known], after[known]))
    return found


MEASURED = measured()


@pytest.mark.parametrize(("name", "before", "after"), MEASURED, ids=[name for name, *_ in MEASURED])
def test_measured_motions_are_coherent_and_what_is_wrong_with_them_is_named(name: str, before: np.ndarray, after: np.ndarray) -> None:
    found = motion_coherence(before, after)
    assert not found.fault and found.found_again > 0.9 and found.volume_ratio == pytest.approx(1.0, abs=0.1)
    shuffled = after[np.random.default_rng(1).permutation(len(after))]
    row_numbers = before[np.lexsort(np.round(before, 1).T)], after[np.lexsort(np.round(after, 1).T)]
    for (a, b), words in (
        ((before, shuffled), "labels of the two states do not correspond"),
        (row_numbers, "labels of the two states do not correspond"),
        ((before, after * (-1.0, 1.0, 1.0)), "mirror image"),
        ((before, after[:, [1, 0, 2]]), "mirror image"),
        ((before, 0.1 * after), "other units"),
        ((1e-3 * before, after), "other units"),
    ):
        assert words in motion_coherence(a, b).fault
        with pytest.raises(InputError, match=f"{name}: .*{words}"):
            require_coherent(a, b, name)


def test_a_stray_marker_is_named() -> None:
    before = lattice((5, 5, 5), 10.0, 0.6)
    after = before * (1.1, 1.1, 0.8)
    after[[60, 77]] = after[[77, 60]]  # two labels exchanged
    found = motion_coherence(before, after)
    assert not found.fault and found.strays.tolist() == [60, 77]
    assert strays_named(np.arange(1, 126), found) == "61, 78"


def test_too_few_markers_are_not_judged_but_for_their_extent() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.uniform(0.0, 30.0, (6, 3)), rng.uniform(0.0, 30.0, (6, 3))
    assert not motion_coherence(before, after).fault
    assert "other units" in motion_coherence(before, 0.1 * before).fault
    assert not motion_coherence(np.zeros((0, 3)), np.zeros((0, 3))).fault
    with pytest.raises(InputError, match="one shape"):
        motion_coherence(before, after[:5])


def test_markers_in_a_plane_are_judged_by_their_labels() -> None:
    before = lattice((7, 6, 1), 5.0, 0.5)
    before[:, 2] = 3.0
    after = before * (1.1, 0.9, 1.0)
    assert not motion_coherence(before, after).fault and np.isnan(motion_coherence(before, after).volume_ratio)
    assert "do not correspond" in motion_coherence(before, after[::-1][np.random.default_rng(0).permutation(42)]).fault


@pytest.mark.parametrize("factor", [0.1, 0.0737, 25.4])  # cm for mm; compressed 2500-fold; inches
@pytest.mark.parametrize("n", [60, 700])
def test_clouds_in_other_units_are_not_linked(n: int, factor: float) -> None:
    cloud = particle_cloud(n, 1)
    with pytest.raises(InputError, match="lengths changed by a factor"):
        link_markers(cloud.reference, factor * cloud.deformed)


def test_chance_links_lose_their_confidence() -> None:
    cloud = particle_cloud(60, 1)
    assert link_markers(cloud.reference, cloud.deformed).confidence.mean() > 0.9
    blurred = cloud.deformed + 0.35 * np.random.default_rng(0).normal(size=cloud.deformed.shape)
    try:
        assert link_markers(cloud.reference, blurred).confidence.mean() < 0.9
    except InputError as error:
        assert "no common structure" in str(error)


def test_an_affine_motion_that_a_table_rounds_has_no_strays() -> None:
    """Neighbours that are off by rounding only, some by nothing, must not reduce a fit to the few that lie in one plane."""
    grid = np.stack(np.meshgrid(*[np.arange(10.0, 51.0, 10.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    moved = np.round(grid * [np.sqrt(4 / 3), np.sqrt(4 / 3), 0.75], 3)
    found = motion_coherence(grid, moved)
    assert found.residual.max() < 1e-3
    assert not len(found.strays)
