"""Markers that cannot be those of the object are refused before anything is solved; those of measured gels are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from squeezed_box import squeezed_box

from naibu import datasets
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading, Shape
from naibu.core.markers import Markers
from naibu.core.rigid_transform import rotation_matrix
from naibu.identification.from_markers.checks.marker_checks import check_markers


def shuffled(points: FloatArray) -> FloatArray:
    return points[np.random.default_rng(3).permutation(len(points))]


def mirrored(points: FloatArray) -> FloatArray:
    return points * [1.0, -1.0, 1.0]


def exchanged(points: FloatArray) -> FloatArray:
    return points[:, [2, 1, 0]]


def all_at_one_point(points: FloatArray) -> FloatArray:
    return np.full_like(points, 7.0)


def two_at_one_point(points: FloatArray) -> FloatArray:
    points[11] = points[40]
    return points


def sized(size: tuple[float, float, float]) -> Experiment:
    good = squeezed_box()
    return replace(good, shape=Shape("box", size))


def turned(points: FloatArray) -> FloatArray:
    """x, y, z become y, z, x, in both states: a rotation, so that the object lies on its side."""
    return points[:, [1, 2, 0]]


def swapped_states() -> Experiment:
    good = squeezed_box()
    first, second = good.states
    return replace(good, states=(replace(first, markers=second.markers), replace(second, markers=first.markers)))


IMPOSSIBLE = {
    "labels shuffled": (lambda: squeezed_box(loaded=shuffled), ("box/pressed against initial", "labels of the two states do not")),
    "loaded mirrored": (lambda: squeezed_box(loaded=mirrored), ("box/pressed", "mirror image")),
    "initial mirrored": (lambda: squeezed_box(initial=mirrored), ("mirror image",)),
    "axes of one exchanged": (lambda: squeezed_box(loaded=exchanged), ("mirror image", "order of its axes")),
    "axes of both turned": (lambda: squeezed_box(initial=turned, loaded=turned), ("along z", "shortened along y", "axes exchanged")),
    "loaded in cm": (lambda: squeezed_box(loaded=lambda p: 0.1 * p), ("by a factor of 0.108", "other units (cm")),
    "loaded in inches": (lambda: squeezed_box(loaded=lambda p: p / 25.4), ("by a factor of 0.0424", "check the units")),
    "initial in m": (lambda: squeezed_box(initial=lambda p: 1e-3 * p), ("size_mm", "60 x 60 x 60")),
    "states exchanged": (swapped_states, ("stretched", "loaded state exchanged")),
    "height of 600": (lambda: squeezed_box(stated_mm={"pressed": 600.0}), ("height_stated_mm = 600", "60 mm")),
    "height in cm": (lambda: squeezed_box(stated_mm={"pressed": 4.5}), ("4.5 mm", "8 %", "75 %")),
    "all at one point": (lambda: squeezed_box(loaded=all_at_one_point), ("all 125 markers", "one point")),
    "initial at one point": (lambda: squeezed_box(initial=all_at_one_point), ("box/initial", "one point")),
    "two at one point": (lambda: squeezed_box(loaded=two_at_one_point), ("markers 12 and 41", "same point")),
    "no motion": (lambda: squeezed_box({"pressed": 60.0}, stated_mm={"pressed": 45.0}), ("did not move", "45 mm", "15 mm")),
    "size in cm": (lambda: sized((900.0, 900.0, 900.0)), ("size_mm", "900 x 900 x 900", "22 times")),
    "height ten times too large": (lambda: sized((60.0, 60.0, 600.0)), ("along z", "600 mm", "40")),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_what_no_loading_can_do_is_refused(name: str) -> None:
    make, words = IMPOSSIBLE[name]
    with pytest.raises(InputError) as caught:
        check_markers([make()])
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("name", [n for n in datasets.names() if not n.endswith("_agar")])
def test_nothing_measured_is_doubted(name: str) -> None:
    doubts = [d.text for d in check_markers([datasets.load(name)])]
    assert not [text for text in doubts if name != "ct_test_piece" or "span only" not in text]  # six markers in one layer


def test_a_scan_in_any_pose_is_not_doubted() -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        turn, shift = rotation_matrix(rng.normal(size=3)), 100.0 * rng.normal(size=3)
        assert check_markers([squeezed_box(loaded=lambda p, turn=turn, shift=shift: p @ turn.T + shift)]) == ()


def test_small_and_large_compressions_of_stiff_and_compressible_bodies_are_not_doubted() -> None:
    for height in (58.0, 50.0, 30.0, 20.0):
        assert check_markers([squeezed_box({"pressed": height})]) == ()
    # a foam keeps its width
    assert check_markers([squeezed_box({"pressed": 30.0}, loaded=lambda p: p * [np.sqrt(0.5), np.sqrt(0.5), 1.0])]) == ()


@pytest.mark.parametrize(
    ("experiment", "words", "grave"),
    [
        # both tables upside down: the base moves and the plate stands still
        (squeezed_box(initial=lambda p: p * [1, -1, -1], loaded=lambda p: p * [1, -1, -1]), "towards the base", True),
        (
            squeezed_box(initial=lambda p: p * [1, -1, -1], loaded=lambda p: p * [1, -1, -1], layers=(("gel", 60.0),)),
            "towards the base",
            False,
        ),
        (squeezed_box({"pressed": 57.0}, stated_mm={"pressed": 30.0}), "mean 50 %", False),
        (squeezed_box(loaded=lambda p: 1.2 * p), "times the volume", False),
        (squeezed_box({"pressed": 60.0}, stated_mm={}), "no deformation beyond the noise", True),
        (replace(squeezed_box(stated_mm={}), shape=Shape("box", (60.0, 60.0, 150.0))), "span only 27 %", False),
    ],
)
def test_what_is_unlikely_is_doubted(experiment: Experiment, words: str, grave: bool) -> None:
    doubts = check_markers([experiment])
    assert any(words in d.text and d.grave is grave for d in doubts), doubts


def test_a_lattice_that_was_turned_over_and_put_down_elsewhere_is_not_doubted() -> None:
    """Where the scans share no frame, which end moved cannot be known."""
    moved = squeezed_box(initial=lambda p: p * [1, -1, -1], loaded=lambda p: p * [1, -1, -1] + [0.0, 30.0, 4.0])
    assert check_markers([moved]) == ()


def test_side_plates_press_along_their_axis() -> None:
    good = squeezed_box(initial=turned, loaded=turned)  # shortened along y
    assert check_markers([replace(good, loading=Loading("side_plates", bar_axis="y"))]) == ()
    with pytest.raises(InputError, match="pressed along x, but its markers are stretched"):
        check_markers([replace(good, loading=Loading("side_plates", bar_axis="x"))])


def test_too_few_and_flat_clouds_are_left_to_the_search() -> None:
    good = squeezed_box()
    for chosen in (slice(0, 6), slice(0, 25)):  # six markers; one layer of the lattice
        states = tuple(
            replace(s, markers=Markers.from_arrays(s.markers.ids[chosen], s.markers.points[chosen] * [1, 1, 1])) for s in good.states
        )
        flat = replace(good, states=states, shape=Shape("box", (60.0, 60.0, 2.0)), layers=good.layers[:1])
        flat = replace(flat, states=(flat.states[0], replace(flat.states[1], stated_mm=1.5)))
        assert not [d for d in check_markers([flat]) if "span" not in d.text]
