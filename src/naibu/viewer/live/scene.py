"""What the live page draws: the scene, sent once, and the frames, sent as bytes."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from naibu.core.arrays import AnyArray, Float32Array, FloatArray, IntArray
from naibu.viewer.live.closed_surface import is_closed
from naibu.viewer.live.cut_outline import cut_outline
from naibu.viewer.motion_page import RigidShape

MAGIC = b"NLV5"
HEADER = np.dtype(
    [
        ("magic", "S4"),
        ("frame", "<u4"),
        ("nodes", "<u4"),
        ("flags", "<u4"),
        ("tool", "<i4"),
        ("gripped", "<i4"),
        ("valued", "<u4"),
        ("topology", "<u4"),
        ("time_s", "<f4"),
        ("force", "<f4", 3),
        ("pull", "<f4", 3),
        ("centre", "<f4", 3),
        ("penetration", "<f4"),
        ("indentation", "<f4"),
        ("steps_per_s", "<f4"),
        ("real_time", "<f4"),
        ("unbalanced", "<f4"),
        ("rotation", "<f4", 4),
        ("readings", "<u4"),
        ("cut_stage", "<i4"),
    ]
)
PAUSED, DRIVING, RECORDING, REPLAYING, FAILED, HELD, UNDER_WAY, PREPARING = 1, 2, 4, 8, 16, 32, 64, 128


@dataclass(frozen=True, slots=True)
class LiveReading:
    """A quantity that frames carry beside positions, and the page shows as a number and a curve.

    Attributes
    ----------
    name : str
        What is read.
    unit : str
        Its unit; empty for none.
    plot : str
        Name of the axes in which its curve is drawn, a few words; curves of one plot have one unit.
    explanation : str
        What is to be known of it; shown with the number.
    states : tuple of str
        What the values 0 and 1 mean, where it is no quantity but a state: one of them is shown, and no curve.
    """

    name: str
    unit: str
    plot: str
    explanation: str = ""
    states: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class LiveScene:
    """What does not change while a simulation runs.

    Attributes
    ----------
    title : str
        Heading.
    sentences : sequence of str
        What is simulated.
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm.
    faces : ndarray, shape (f, 3), int
        Triangles of the surface.
    cells : ndarray, shape (m, 4), int
        Tetrahedra, of which the section at the clip plane is drawn.
    tools : sequence of RigidShape
        Tools, in the order in which frames number them.
    fixtures : sequence of RigidShape
        Rigid bodies that stay where they are.
    fixture_centres : ndarray, shape (k, 3)
        Their positions, mm.
    marker_nodes, marker_weights : ndarray, shape (q, c)
        Nodes and weights that interpolate markers; without rows where there are none.
    strain : str
        Name and unit of the strain that frames carry on request.
    frame_s : float
        Simulated time between frames, s.
    topology : int
        Number of the scene; frames with another one belong to another scene.
    cuttable : bool
        Whether the body can be cut.
    readings : sequence of LiveReading
        What frames carry, in that order.
    cut_stages : sequence of str
        What is computed before a cut opens, in the order in which frames number it.
    cautions : sequence of str
        What the page says of the forces of each tool while it is in play; empty texts, or none at all, where there is nothing to say.
    grip_caution : str
        What it says of the force of a grip while no tool is in play.
    """

    title: str
    sentences: Sequence[str]
    points: FloatArray
    faces: IntArray
    cells: IntArray
    tools: Sequence[RigidShape]
    fixtures: Sequence[RigidShape]
    fixture_centres: FloatArray
    strain: str
    frame_s: float
    marker_nodes: IntArray = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    marker_weights: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    topology: int = 0
    cuttable: bool = False
    readings: Sequence[LiveReading] = ()
    cut_stages: Sequence[str] = ()
    cautions: Sequence[str] = ()
    grip_caution: str = ""

    def payload(self) -> dict[str, object]:
        """Return the scene for JSON; ``viewer-src/src/live-decode.js`` is the inverse."""
        return {
            "title": self.title,
            "sentences": list(self.sentences),
            "points": _base64(self.points, "<f4"),
            "faces": _base64(self.faces, "<u4"),
            "cells": _base64(self.cells, "<u4"),
            "closed": is_closed(np.asarray(self.points, dtype=float), self.faces),
            "outline": _base64(cut_outline(np.asarray(self.points, dtype=float), self.faces), "<u4"),
            "tools": [_shape(s) | {"caution": said} for s, said in zip(self.tools, self.cautions or [""] * len(self.tools), strict=True)],
            "fixtures": [_shape(s) | {"centre": c.tolist()} for s, c in zip(self.fixtures, self.fixture_centres, strict=True)],
            "markers": {
                "nodes": _base64(self.marker_nodes, "<u4"),
                "weights": _base64(self.marker_weights, "<f4"),
                "each": self.marker_nodes.shape[1],
            },
            "grip_caution": self.grip_caution,
            "strain": self.strain,
            "frame_s": self.frame_s,
            "topology": self.topology,
            "cuttable": self.cuttable,
            "readings": [asdict(reading) for reading in self.readings],
            "cut_stages": list(self.cut_stages),
        }


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """A frame as it is sent.

    Attributes
    ----------
    number : int
        Frames since the beginning.
    time_s : float
        Simulated time, s.
    positions : ndarray, shape (n, 3)
        Nodes, mm.
    tool, gripped : int
        Number of the tool in play, and node that is gripped; -1 for none.
    centre : ndarray, shape (3,)
        Position of the tool, mm.
    force, pull : ndarray, shape (3,)
        Of the tool and of the grip on the body, mN.
    penetration_mm, indentation_mm : float
        How deep the surface lies in the tool; how deep the tool lies below it where it is at rest.
    steps_per_s, real_time : float
        Steps a second; simulated seconds a second.
    flags : int
        Sum of `PAUSED`, `RECORDING`, `REPLAYING`, `FAILED`, `HELD` (the tool is held back), `UNDER_WAY` (a step takes longer than a frame),
        `PREPARING` (kernels of cuts are being compiled: none can be made yet).
    strain : callable
        Returns the strain at the nodes (n,), computed when it is asked for.
    topology : int
        Number of the scene that the nodes belong to.
    unbalanced : float
        Out-of-balance forces that the next frames take up, as a fraction of all forces, or of those of contact where that is more.
    rotation : tuple of float
        Of the tool since it was made, as a quaternion, scalar last.
    cut_stage : int
        Number in the scene's stages of what is being computed for a cut; -1 where none is under way.
    readings : ndarray, shape (k, 3)
        Value and both ends of the 95 % interval of every reading of the scene; NaN where there is none.
    """

    number: int
    time_s: float
    positions: FloatArray
    tool: int
    gripped: int
    centre: FloatArray
    force: FloatArray
    pull: FloatArray
    penetration_mm: float
    indentation_mm: float
    steps_per_s: float
    real_time: float
    flags: int
    strain: Callable[[], FloatArray]
    topology: int = 0
    unbalanced: float = 0.0
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    cut_stage: int = -1
    readings: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


def frame_bytes(frame: LiveFrame, driving: bool, values: FloatArray | None = None) -> bytes:
    """Return a frame as bytes: header, positions, where wanted values at the nodes, and readings, in single precision."""
    header = np.zeros(1, HEADER)
    for name, value in (
        ("magic", MAGIC), ("frame", frame.number), ("nodes", len(frame.positions)), ("flags", frame.flags | (DRIVING if driving else 0)),
        ("tool", frame.tool), ("gripped", frame.gripped), ("valued", int(values is not None)),
        ("topology", frame.topology), ("time_s", frame.time_s),
        ("force", frame.force), ("pull", frame.pull), ("centre", frame.centre), ("penetration", frame.penetration_mm),
        ("indentation", frame.indentation_mm),
        ("steps_per_s", frame.steps_per_s), ("real_time", frame.real_time), ("unbalanced", frame.unbalanced),
        ("rotation", frame.rotation), ("readings", len(frame.readings)), ("cut_stage", frame.cut_stage),
    ):  # fmt: skip
        header[name] = value
    parts: list[Float32Array] = [np.asarray(frame.positions, dtype="<f4")]
    if values is not None:
        parts.append(np.asarray(values, dtype="<f4"))
    parts.append(np.asarray(frame.readings, dtype="<f4"))
    return header.tobytes() + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


def _base64(array: AnyArray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")


def _shape(shape: RigidShape) -> dict[str, object]:
    return {"name": shape.name, "kind": shape.kind, "size": shape.size.tolist(), "axes": np.round(shape.axes, 6).ravel().tolist()}
