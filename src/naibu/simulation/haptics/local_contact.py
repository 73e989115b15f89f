"""What a haptic device feels between the steps of a body that takes longer than a millisecond: a local model of its contact.

After a step the reaction of the body is known where the tool was in it. Until the next one it is continued linearly with the place of the
tool, with the stiffness that the last steps showed, and only as long as the tool pushes: the intermediate representation of
:cite:t:`adachi1995`, for deformable bodies that of :cite:t:`barbagli2003`. The tool goes its way a thousand times a second, and the
body follows it step by step. Where a new step contradicts the model, the reaction goes over to it in the time of a step. The stiffness
is that of a step, inertia included, and the largest of the last while: too much makes the tool slow, too little lets it bounce. Steps
end a little out of balance, so that one in which the force hardly changes says little of the stiffness.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray, as_vector, require_positive
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.simulation.frame import Frame
from naibu.simulation.interactive_simulation import FRAME_S, InteractiveSimulation
from naibu.simulation.tool_places import placed

STIFFEST = 2e4  # mN/mm, of the continuation
MEMORY_S = 0.25  # in which a stiffness that a step showed is forgotten: too much makes the tool slow, too little makes it bounce
LEAST_MOTION_MM = 0.03  # along the push, from which a step shows a stiffness
DOUBT = 0.03  # of the push: by a change below it, as where the tool turns back, a step may keep a stiffness but not raise it
ELSEWHERE_S = 0.25  # a tool farther off than it goes in this time was put there by someone else

Order = Callable[[InteractiveSimulation], None]


@dataclass(frozen=True, slots=True, eq=False)
class LocalReaction:
    """Reaction of a body around a place of the tool.

    Attributes
    ----------
    place : ndarray, shape (3,)
        Of the tool, mm.
    direction : ndarray, shape (3,)
        In which it pushes; of length 1.
    push : float
        Force of the tool on the body there, mN; negative where it does not touch: minus stiffness times gap.
    stiffness : float
        Growth of the force with the way of the tool, mN/mm.
    friction_coefficient : float
        That limits the part of the force across.
    """

    place: FloatArray
    direction: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    push: float = 0.0
    stiffness: float = 0.0
    friction_coefficient: float = 0.0

    def at(self, place: FloatArray) -> FloatArray:
        """Return the force (3,), mN, with the tool at a place (3,), mm; zero where it does not push."""
        way = place - self.place
        along = float(way @ self.direction)
        push = self.push + self.stiffness * along
        if push <= 0.0:
            return np.zeros(3)
        across = self.stiffness * (way - along * self.direction) if self.push > 0.0 else np.zeros(3)
        length, most = float(np.linalg.norm(across)), self.friction_coefficient * push
        return np.asarray(push * self.direction + (across if length <= most else across * (most / length)))


@dataclass(frozen=True, slots=True, eq=False)
class LocalFrame:
    """The tool at the end of a step of the local model.

    Attributes
    ----------
    tool : str
        Its name, or an empty string.
    tool_centre : ndarray, shape (3,)
        mm.
    force : ndarray, shape (3,)
        On the body, mN.
    """

    tool: str
    tool_centre: FloatArray
    force: FloatArray


@dataclass(slots=True, eq=False)
class LocalContact:
    """A tool that a haptic device leads beside the steps of the body; see the module.

    Attributes
    ----------
    tools : mapping of str to RigidIndenter
        Those of the simulation.
    fastest_mm_s : float
        At which the tool goes.
    frame_s : float
        A step of the model, s.
    body_step_s : float
        One of the body, in which the reaction goes over to that of a new step, s.

    Raises
    ------
    InputError
        A speed or time that is not positive.
    """

    tools: Mapping[str, RigidIndenter]
    fastest_mm_s: float
    frame_s: float = 1e-3
    body_step_s: float = FRAME_S
    last: LocalFrame = field(init=False, default_factory=lambda: LocalFrame("", np.zeros(3), np.zeros(3)))
    _target: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    _seen: Frame | None = field(init=False, default=None)
    _new: LocalReaction = field(init=False, default_factory=lambda: LocalReaction(np.zeros(3)))
    _old: LocalReaction = field(init=False, default_factory=lambda: LocalReaction(np.zeros(3)))
    _since: float = field(init=False, default=0.0)
    _orders: list[Order] = field(init=False, default_factory=list)
    _asked: str = field(init=False, default="")
    _turned: Rotation = field(init=False, default_factory=Rotation.identity)  # since the last step of the body

    def __post_init__(self) -> None:
        require_positive("fastest_mm_s", self.fastest_mm_s, "mm/s")
        require_positive("frame_s", self.frame_s, "s")
        require_positive("body_step_s", self.body_step_s, "s")

    def take(self, tool: str) -> None:
        """Ask for a tool, which comes into play with the next step of the body."""
        if tool != self._asked:
            self._asked = tool
            self._orders.append(lambda simulation: simulation.take(tool))

    def move(self, centre: ArrayLike) -> None:
        """Lead the tool to a position (3,), mm."""
        self._target = np.asarray(centre, dtype=float)

    def turn(self, rotation: ArrayLike) -> None:
        """Turn the tool further by a rotation vector (3,), rad, in the next step of the body."""
        self._turned = Rotation.from_rotvec(as_vector("rotation", rotation)) * self._turned

    def observe(self, frame: Frame, *, led: bool) -> list[Order]:
        """Take in the last frame of the body; return what the body's simulation is to do before its next one.

        Where no device leads the tool, it is where the frame has it.
        """
        if frame is not self._seen and not frame.under_way:
            tool = self.last.tool
            far = float(np.linalg.norm(frame.tool_centre - self.last.tool_centre)) > ELSEWHERE_S * self.fastest_mm_s
            if frame.tool != tool or far or not led:
                self._target, self._asked = frame.tool_centre, frame.tool
                self.last = LocalFrame(frame.tool, frame.tool_centre, np.zeros(3))
                self._old = self._new = LocalReaction(frame.tool_centre)
                self._turned = Rotation.identity()
            if frame.tool:
                self._continue(frame)
                target, turned = self.last.tool_centre, self._turned.as_rotvec()
                self._orders.append(lambda simulation: simulation.move(target))
                if turned.any():
                    self._orders.append(lambda simulation: simulation.turn(turned))
                    self._turned = Rotation.identity()
            self._seen = frame
        orders, self._orders = self._orders, []
        return orders

    def advance(self) -> LocalFrame:
        """Take one step of the model, and return its end."""
        self._since += self.frame_s
        way = self._target - self.last.tool_centre
        length, most = float(np.linalg.norm(way)), self.fastest_mm_s * self.frame_s
        centre = self._target if length <= most else self.last.tool_centre + way * (most / length)
        share = min(self._since / self.body_step_s, 1.0)
        force = share * self._new.at(centre) + (1.0 - share) * self._old.at(centre) if self.last.tool else np.zeros(3)
        self.last = LocalFrame(self.last.tool, centre, force)
        return self.last

    def _continue(self, frame: Frame) -> None:
        """Go over to the reaction of a new frame."""
        before, place = self._new, frame.tool_centre
        stiffness = before.stiffness * max(0.0, 1.0 - self.body_step_s / MEMORY_S)
        push, direction, tool = float(np.linalg.norm(frame.force)), before.direction, self.tools[frame.tool]
        if push > 0.0:
            direction = frame.force / push
            moved = float((place - before.place) @ direction)
            if abs(moved) > LEAST_MOTION_MM:
                change = push - max(before.push, 0.0) * float(before.direction @ direction)
                most = before.stiffness if abs(change) < DOUBT * push and before.stiffness > 0.0 else STIFFEST
                stiffness = max(stiffness, min(change / moved, most))
        elif stiffness > 0.0:
            surface = frame.positions[np.unique(frame.body.faces)]
            push = -stiffness * max(float(placed(tool, place, frame.tool_rotation).gap(surface).min()), 0.0)
        new = LocalReaction(place, direction, push, stiffness, tool.static_friction)
        self._old, self._new, self._since = before, new, 0.0
