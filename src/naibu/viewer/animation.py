"""Animation of plane meshes as a self-contained page: several bodies side by side, coloured, with one time slider."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.viewer.embedding import embedded_json
from naibu.viewer.page_frame import filled_template

STEPS = 32_000  # quantisation levels of the 16-bit numbers that the page stores


@dataclass(frozen=True, slots=True, eq=False)
class MovingBody:
    """A deforming plane mesh over time.

    Attributes
    ----------
    title : str
        Caption of the body.
    points : ndarray, shape (n, 2)
        Node positions in the reference configuration, mm.
    triangles : ndarray, shape (m, 3), int
        Node numbers.
    displacement : ndarray, shape (s, n, 2)
        Displacement of the nodes at every time step, mm.
    values : ndarray, shape (s, n)
        Node values shown as colours.
    marks : tuple of (name, ndarray of shape (s, 2))
        Names and paths of points, such as measured markers, mm; NaN where unknown.
    """

    title: str
    points: FloatArray
    triangles: IntArray
    displacement: FloatArray
    values: FloatArray
    marks: tuple[tuple[str, FloatArray], ...] = ()


def animation_html(title: str, times_s: FloatArray, bodies: tuple[MovingBody, ...], value_name: str, sentences: Sequence[str] = ()) -> str:
    """Return the page.

    Parameters
    ----------
    title : str
        Heading.
    times_s : ndarray, shape (s,)
        Times of the steps, s.
    bodies : tuple of MovingBody
        Bodies, shown side by side at one scale of length and colour.
    value_name : str
        Quantity shown as colours, with its unit.
    sentences : sequence of str
        Paragraphs below the title.

    Raises
    ------
    InputError
        No body, or a number of steps that differs from the number of times.
    """
    if not bodies:
        raise InputError("an animation needs at least one body")
    for body in bodies:
        if body.displacement.shape != (len(times_s), *body.points.shape) or body.values.shape != (len(times_s), len(body.points)):
            raise InputError(f"{body.title!r}: displacement and values must have {len(times_s)} steps of {len(body.points)} points")
    low = float(min(np.nanmin(body.values) for body in bodies))
    high = float(max(np.nanmax(body.values) for body in bodies))
    payload = {
        "times": [round(float(t), 6) for t in times_s],
        "value": value_name,
        "low": low,
        "high": high if high > low else low + 1.0,
        "bodies": [_packed(body, low, high) for body in bodies],
    }
    words = "".join(f"<p>{escape(s)}</p>" for s in sentences)
    return filled_template("animation.html", {"TITLE": escape(title), "NOTE": words, "DATA": embedded_json(payload)})


def _packed(body: MovingBody, low: float, high: float) -> dict[str, object]:
    largest = float(np.abs(body.displacement).max()) or 1.0
    span = high - low or 1.0
    return {
        "title": body.title,
        "points": np.round(body.points, 4).ravel().tolist(),
        "triangles": body.triangles.ravel().tolist(),
        "quantum": largest / STEPS,
        "displacement": _base64(body.displacement / largest * STEPS),
        "values": _base64((body.values - low) / span * STEPS),
        "steps": STEPS,
        "marks": [
            {"name": name, "path": [None if np.isnan(p).any() else np.round(p, 3).tolist() for p in path]} for name, path in body.marks
        ],
    }


def _base64(values: FloatArray) -> str:
    return base64.b64encode(np.round(np.nan_to_num(values)).astype("<i2").tobytes()).decode()
