"""The page of slices: what it carries is what went in."""

from __future__ import annotations

import base64
import gzip
import json
import re

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.viewer.slices import FEW_VOXELS, Overlay, SliceView, slices_html

Array = np.ndarray


def view(shape: tuple[int, int, int] = (5, 8, 6), **changed: object) -> SliceView:
    rng = np.random.default_rng(0)
    intensity = rng.uniform(0.0, 1000.0, shape)
    u = rng.normal(0.0, 2.0, (*shape, 3))
    u[0] = np.nan
    given = {
        "title": "From <a> to b",
        "sentences": ("It moved.",),
        "spacing_mm": np.array([0.5, 1.0, 2.0]),
        "images": [("before", intensity), ("after", intensity + 100.0)],
        "displacement": u,
        "overlays": [Overlay("displacement, mm", np.linalg.norm(u, axis=-1)), Overlay("volume ratio J", 1.0 + 0.1 * u[..., 0], middle=1.0)],
    }
    return SliceView(**{**given, **changed})  # type: ignore[arg-type]


def payload(page: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found
    return json.loads(found[1])


def unpacked(text: str, kind: str = "u1") -> Array:
    return np.frombuffer(gzip.decompress(base64.b64decode(text)), kind)


def test_values_survive_within_their_steps() -> None:
    v = view()
    data = payload(slices_html(v))
    assert data["size"] == [6, 8, 5]
    image = data["images"][0]
    intensity = image["low"] + unpacked(image["data"]) / 255 * (image["high"] - image["low"])
    inside = (v.images[0][1].ravel() > image["low"]) & (v.images[0][1].ravel() < image["high"])
    assert np.abs(intensity - v.images[0][1].ravel())[inside].max() <= 0.51 / 255 * (image["high"] - image["low"])
    arrows = unpacked(data["arrows"]["data"], "<i2").reshape(5, 8, 6, 3)
    assert (arrows[0] == -32768).all()
    assert np.abs(arrows[1:] * data["arrows"]["quantum"] - v.displacement[1:]).max() <= 0.51 * data["arrows"]["quantum"]


def test_positions_start_at_the_origin_of_the_grid() -> None:
    assert payload(slices_html(view()))["first"] == [0.0, 0.0, 0.0]
    assert payload(slices_html(view(origin_mm=(-3.0, 4.0, 10.5))))["first"] == [-3.0, 4.0, 10.5]


def test_what_is_not_known_has_no_colour_and_two_sided_scales_are_even() -> None:
    data = payload(slices_html(view()))
    size, ratio = data["overlays"]
    assert (unpacked(size["data"]).reshape(5, 8, 6)[0] == 255).all()
    assert (unpacked(size["data"]).reshape(5, 8, 6)[1:] < 255).all()
    assert ratio["diverging"]
    assert 1.0 - ratio["low"] == pytest.approx(ratio["high"] - 1.0)


def test_large_volumes_are_thinned_along_their_finest_axis() -> None:
    shape = (20, 300, 600)
    v = view(shape, spacing_mm=np.array([0.5, 1.0, 2.0]))
    data = payload(slices_html(v))
    assert np.prod(data["size"]) <= FEW_VOXELS
    assert data["size"] == [200, 300, 20]
    assert data["spacing"] == [1.5, 1.0, 2.0]


def test_the_page_needs_nothing_from_outside_and_escapes_names() -> None:
    page = slices_html(view())
    assert "From &lt;a&gt; to b" in page
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)


def test_arrays_on_different_grids_are_refused() -> None:
    with pytest.raises(InputError, match="'strain' has shape"):
        slices_html(view(overlays=[Overlay("strain", np.zeros((2, 2, 2)))]))
    with pytest.raises(InputError, match="at least one image"):
        slices_html(view(images=[]))


def test_letters_name_the_nearest_direction_of_the_scan_at_both_ends_of_each_axis() -> None:
    turn = np.array(
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    )  # columns: x of the grid to the back, y to the right, z downwards
    data = payload(slices_html(view(direction=turn)))
    assert data["letters"] == [["A", "P"], ["L", "R"], ["S", "I"]]
    assert data["direction"] == turn.tolist()
    assert payload(slices_html(view()))["letters"] == [["R", "L"], ["A", "P"], ["I", "S"]]
