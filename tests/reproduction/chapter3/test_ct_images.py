"""CT images of the printed markers: spots lie where the markers were put, and spacings grow as the printed positions say."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu import datasets
from naibu.reproduction.chapter3.ct_images import MARKERS, VOXEL_MM, LayerImage, images_of_markers, layer_images, spacing_change
from naibu.reproduction.chapter3.experiment import EXPERIMENT


@pytest.fixture(scope="module")
def images() -> tuple[LayerImage, ...]:
    return layer_images()


def test_every_printed_marker_is_found_within_half_a_voxel(images: tuple[LayerImage, ...]) -> None:
    for image in images:
        assert len(image.ids) >= 14
        off = np.linalg.norm(image.found - image.printed, axis=1)
        assert off.max() < 0.5 * VOXEL_MM[0], (image.layer, image.state)


def test_a_layer_holds_the_markers_of_one_height() -> None:
    markers = datasets.load(EXPERIMENT).initial
    heights = [np.nanmean(markers.points[(markers.ids - 1) // MARKERS == layer, 2]) for layer in range(4)]
    assert heights == pytest.approx([12.0, 22.0, 41.0, 51.0], abs=0.6)


def test_markers_of_the_softer_gel_move_further_apart(images: tuple[LayerImage, ...]) -> None:
    growth = [spacing_change(a, b) for a, b in zip(images[::2], images[1::2], strict=True)]
    assert min(growth[:2]) > max(growth[2:]) > 1.0  # as the report says
    first = images[0], images[1]
    common, one, two = np.intersect1d(first[0].ids, first[1].ids, return_indices=True)
    before, after = first[0].printed[one], first[1].printed[two]
    ratios = [
        np.linalg.norm(after[i] - after[j]) / np.linalg.norm(before[i] - before[j])
        for i in range(len(common))
        for j in range(i)
        if np.linalg.norm(before[i] - before[j]) < 12.5
    ]
    assert growth[0] == pytest.approx(np.mean(ratios), rel=5e-3)


def test_the_section_draws_both_states_of_four_layers() -> None:
    section = images_of_markers()
    assert section.figures[0].name == "Fig. 3.33"
    assert len(section.figures) == 5
    for figure in section.figures:
        canvas = Canvas(figsize=figure.size)
        figure.draw(canvas)
        canvas.draw_without_rendering()
    assert all(str(r[1]).split(" of ")[0] == str(r[1]).split(" of ")[1] for r in section.tables[0].rows)
