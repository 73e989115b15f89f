"""The page of an animation."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.viewer.animation import MovingBody, animation_html

POINTS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
TRIANGLES = np.array([[0, 1, 2]])


def test_what_the_page_holds_is_what_was_given() -> None:
    rng = np.random.default_rng(0)
    u, values = rng.standard_normal((4, 3, 2)), rng.uniform(2.0, 5.0, (4, 3))
    marks = (("marker 1", np.array([[1.0, 2.0], [np.nan, 1.0], [3.0, 4.0], [5.0, 6.0]])),)
    body = MovingBody("a </script> body", POINTS, TRIANGLES, u, values, marks)
    page = animation_html("A <title>", np.arange(4.0), (body,), "u, mm")
    assert "</script> body" not in page and "A &lt;title&gt;" in page and "https:" not in page
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1])
    stored = data["bodies"][0]
    moved = np.frombuffer(base64.b64decode(stored["displacement"]), "<i2").reshape(u.shape) * stored["quantum"]
    coloured = np.frombuffer(base64.b64decode(stored["values"]), "<i2").reshape(values.shape) / stored["steps"]
    np.testing.assert_allclose(moved, u, atol=np.abs(u).max() / 30_000)
    np.testing.assert_allclose(data["low"] + coloured * (data["high"] - data["low"]), values, atol=2e-4)
    assert stored["marks"][0]["path"][1] is None


def test_steps_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="4 steps"):
        animation_html("t", np.arange(4.0), (MovingBody("b", POINTS, TRIANGLES, np.zeros((3, 3, 2)), np.zeros((4, 3))),), "u")
    with pytest.raises(InputError, match="at least one"):
        animation_html("t", np.arange(4.0), (), "u")
