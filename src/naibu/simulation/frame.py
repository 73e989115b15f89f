"""What is shown of an interactive simulation at one instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.simulation.interactive_bodies import InteractiveBody
from naibu.simulation.tool_places import indentation_depth, placed


@dataclass(frozen=True, slots=True, eq=False)
class KeptState:
    """A state of an interactive simulation to return to: body, state of its session, time, s, tool, and its position, mm, and rotation."""

    body: InteractiveBody
    state: Any
    time_s: float
    tool: str
    centre: FloatArray
    rotation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What a frame shows.

    Attributes
    ----------
    body : InteractiveBody
        The body, whose nodes the positions are those of.
    number : int
        Frames since the beginning.
    time_s : float
        Simulated time, s.
    positions : ndarray, shape (n, 3)
        Nodes, mm.
    tool : str
        Name of the tool in play, or an empty string.
    tool_centre : ndarray, shape (3,)
        Its position, mm.
    tool_rotation : ndarray, shape (3, 3)
        Its rotation since it was made.
    force : ndarray, shape (3,)
        Mean force of the tool on the body during the frame, mN.
    pull : ndarray, shape (3,)
        Mean force of the grip on the body, mN.
    surface : ndarray, shape (s,), int64
        Nodes of the surface.
    shape : RigidIndenter, optional
        The tool in play, as it was made.
    gripped : int
        Node that is gripped, or -1.
    failed : str
        Why the last step was taken back; empty where none was.
    topology : int
        Counts the cuts, undone ones included.
    unbalanced : float
        Out-of-balance forces that the next frames take up, as a fraction of all forces, or of those of contact where that is more.
    under_way : bool
        Whether a step takes longer than a frame: all but the number is as before it, and the positions where parts of it have been taken.
    held : bool
        Whether crushed cells held the tool back; see `naibu.simulation.held_tool`.
    """

    body: InteractiveBody
    number: int
    time_s: float
    positions: FloatArray
    tool: str
    tool_centre: FloatArray
    tool_rotation: FloatArray
    force: FloatArray
    pull: FloatArray
    surface: IntArray
    shape: RigidIndenter | None = None
    gripped: int = -1
    failed: str = ""
    topology: int = 0
    unbalanced: float = 0.0
    under_way: bool = False
    held: bool = False

    def of_a_step_under_way(self, midway: FloatArray | None) -> Frame:
        """Return the next frame, whose step takes longer, with nodes midway (n, 3), mm, where parts of it have been taken."""
        positions = self.positions if midway is None else midway
        return replace(self, number=self.number + 1, positions=positions, failed="", under_way=True)

    @property
    def penetration_mm(self) -> float:
        """How deep the nodes of the surface lie in the tool at most; found when it is asked for, as most frames of 1 ms are not shown."""
        if self.shape is None:
            return 0.0
        gaps = self._placed(self.shape).gap(self.positions[self.surface])
        return max(0.0, -float(gaps.min()))

    @property
    def indentation_mm(self) -> float:
        """How deep the tool lies below the surface at rest, along its force; see `naibu.simulation.tool_places.indentation_depth`."""
        if self.shape is None:
            return 0.0
        return indentation_depth(self._placed(self.shape), self.force, self.body.points, self.positions, self.body.faces)

    def _placed(self, shape: RigidIndenter) -> RigidIndenter:
        return placed(shape, self.tool_centre, self.tool_rotation)
