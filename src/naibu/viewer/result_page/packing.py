"""Compact encoding of scenes for the page: quantised positions, differences along the load steps, gzip.

``viewer-src/src/decode.js`` is the inverse.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.viewer.embedding import embedded_bytes
from naibu.viewer.json_values import jsonable
from naibu.viewer.result_page.payload import Scene

SURFACE_QUANTUM_MM = 0.01
MARKER_QUANTUM_MM = 0.001


def packed_scene(scene: Scene) -> dict[str, object]:
    """Return a scene as integers.

    Positions become multiples of ``quantum_mm``; along the steps first and second differences are stored, which are small because
    the motion is smooth. Faces become differences of neighbouring entries. Unmeasured coordinates are None.
    """
    reference = _multiples(scene.reference_surface, SURFACE_QUANTUM_MM)
    initial = _multiples(scene.initial_markers, MARKER_QUANTUM_MM)
    surfaces = [_multiples(s.surface, SURFACE_QUANTUM_MM) for s in scene.steps]
    markers = [_multiples(s.markers, MARKER_QUANTUM_MM) for s in scene.steps]
    return {
        "name": scene.name,
        "experiment": scene.experiment,
        "state": scene.state,
        "role": scene.role,
        "quantum_mm": {"surface": SURFACE_QUANTUM_MM, "marker": MARKER_QUANTUM_MM},
        "faces": np.diff(np.asarray(scene.faces, dtype=np.int64).ravel(), prepend=0).tolist(),
        "reference_surface": reference.tolist(),
        "surfaces": _differences(reference, surfaces),
        "initial_markers": initial.tolist(),
        "markers": _differences(initial, markers),
        "steps": [
            {
                "label": s.label,
                "load_mm": jsonable(s.load_mm),
                "boxes": [jsonable(np.array([*b.centre_mm, *b.half_size_mm, *b.turned]), 5) for b in s.indenters],
            }
            for s in scene.steps
        ],
        "marker_ids": scene.marker_ids.tolist(),
        "measured": [None if np.isnan(v) else round(v / MARKER_QUANTUM_MM) for v in scene.measured.ravel().tolist()],
        "sd_mm": jsonable(scene.sd_mm, 3),
        "layer": scene.layer.tolist(),
    }


def packed_scenes(scenes: Sequence[Scene]) -> str:
    """Return all scenes as base64-encoded, gzipped JSON; equal scenes give equal text."""
    text = json.dumps({"scenes": [packed_scene(s) for s in scenes]}, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return embedded_bytes(text.encode())


def thinned(scene: Scene) -> Scene:
    """Return the scene without every other load step; the first and the last are kept."""
    steps = scene.steps
    kept = tuple(s for i, s in enumerate(steps) if i % 2 == 0 or i == len(steps) - 1)
    return replace(scene, steps=kept)


def _multiples(points: FloatArray, quantum_mm: float) -> IntArray:
    return np.rint(np.asarray(points, dtype=np.float64).ravel() / quantum_mm).astype(np.int64)


def _differences(start: IntArray, points: Sequence[IntArray]) -> list[list[int]]:
    out = []
    for i, now in enumerate(points):
        if i == 0:
            difference = now - start
        elif i == 1:
            difference = now - points[0]
        else:
            difference = now - 2 * points[i - 1] + points[i - 2]
        out.append(difference.tolist())
    return out
