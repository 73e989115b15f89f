"""Interactive simulation: a tool that follows a person's hand, gripping and pulling, undo, and recording, one frame at a time.

A frame is a fixed number of steps of the body's session. The tool never moves faster than a limit, so that a jump of the hand, or a pause
of the connection, does not carry it through the body; where a step fails, the simulation returns to the frame before, and the tool stays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, as_vector, require_positive
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.rigid_transform import rotation_between, rotation_matrix
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_strain.sessions.divided_session import DividedSession
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.simulation.cuts.background_cut import BackgroundCut, cut_in_balance
from naibu.simulation.cuts.lattice_cut import LatticeCut
from naibu.simulation.frame import Frame, KeptState
from naibu.simulation.held_tool import HeldTool, outside_planes
from naibu.simulation.interactive_bodies import NO_NODES, AnySession, FiniteElementBody, InteractiveBody
from naibu.simulation.tool_places import FollowedHand, farthest_in_a_step, placed, towards, turning_towards, waiting_place

FRAME_S = 1.0 / 60.0
REACH = 2.0  # extents of the body around its centre in which the tool stays
SPEED = 3.0  # extents of the body a second that tool and grip move at most
PATIENCE = 2  # steps without a balance, one after the other, behind which the next one has the body begin anew from its shape at rest
UNDO = 20  # states kept
LEAVING_S = 3.0  # simulated time in which a tool that is put away leaves the body at the latest


@dataclass(slots=True, eq=False)
class InteractiveSimulation:
    """A body that is touched, frame by frame; commands take effect in the next frame.

    Attributes
    ----------
    body : InteractiveBody
        What is touched.
    tools : mapping of str to RigidIndenter
        Tools by name, each made outside of the body: where it was made is where it waits.
    frame_s : float
        Simulated time of a frame, s.
    budget_s : float
        Time of the processor after which a frame leaves the step of a body of finite elements to the next one, s.
    delay_s : float
        Delay with which tool and grip follow the places to which they are led, s, so that their velocities do not leap; 0 follows at once.
    """

    body: InteractiveBody
    tools: Mapping[str, RigidIndenter]
    frame_s: float = FRAME_S
    budget_s: float = np.inf
    delay_s: float = 0.0
    _session: AnySession = field(init=False)
    _tool: str = field(init=False, default="")
    _centre: FloatArray = field(init=False)
    _target: FloatArray = field(init=False)
    _rotation: FloatArray = field(init=False, default_factory=lambda: np.eye(3))
    _rotation_target: FloatArray = field(init=False, default_factory=lambda: np.eye(3))
    _nodes: IntArray = field(init=False, default_factory=lambda: NO_NODES)
    _gripped: int = field(init=False, default=-1)
    _pull_target: FloatArray = field(init=False)
    _tool_hand: FollowedHand = field(init=False, default_factory=FollowedHand)
    _grip_hand: FollowedHand = field(init=False, default_factory=FollowedHand)
    _kept: deque[KeptState] = field(init=False)
    _last: Frame = field(init=False)
    _topology: int = field(init=False, default=0)
    _surface: IntArray = field(init=False)
    _low: FloatArray = field(init=False)  # corners of the box around the body at rest, mm
    _high: FloatArray = field(init=False)
    _extent: float = field(init=False)
    _held: HeldTool = field(init=False)
    _cutting: BackgroundCut | None = field(init=False, default=None)
    _next: str | None = field(init=False, default=None)  # tool that is taken when the one in play has left the body
    _leaving: int = field(init=False, default=0)  # frames in which it was led away
    _failures: int = field(init=False, default=0)  # of the last frames, one after the other
    _trapped: str = field(init=False, default="")  # what is to be said of a tool that did not leave the body
    _under_way: tuple[FloatArray, FloatArray, FloatArray] | None = field(init=False, default=None)  # motion of a step begun

    def __post_init__(self) -> None:
        require_positive("frame_s", self.frame_s, "s")
        if self.frame_s < self.body.step_s:
            raise InputError(f"frame_s is {self.frame_s:g} s, less than a step of the body, {self.body.step_s:g} s; make it longer")
        for name, tool in self.tools.items():
            if tool.gap(self.body.points).min() < 0.0:
                raise InputError(f"tool {name!r} begins inside the body; make it outside, where it waits")
        self._kept = deque(maxlen=UNDO)
        self._begin(self.body)
        self._centre = self._target = self._pull_target = np.zeros(3)
        self._last = self._frame(0, 0.0, np.zeros(3), np.zeros(3), "")

    @property
    def steps(self) -> int:
        """Steps of a frame."""
        return max(1, round(self.frame_s / self.body.step_s))

    @property
    def extent_mm(self) -> float:
        """Largest edge of the box around the body at rest, mm."""
        return self._extent

    @property
    def fastest_mm_s(self) -> float:
        """Speed at which tool and grip move at most, mm/s."""
        return SPEED * self.extent_mm

    @property
    def last(self) -> Frame:
        """The last frame."""
        return self._last

    @property
    def cut_stage(self) -> int:
        """Number in `CUT_STAGES` of what is being done for the cut that was begun; -1 where none was, or it has opened."""
        return self._cutting.stage if self._cutting else -1

    def take(self, tool: str) -> None:
        """Bring a tool into play, where it waits; an empty name puts the one in play away.

        One that presses finite elements is lifted first, in the next frames: no step finds the balance of a dent that is let go at once.
        One that has not left the body within `LEAVING_S` stays in play, and `finish_cut` says so.

        Raises
        ------
        InputError
            There is no such tool.
        """
        if tool and tool not in self.tools:
            raise InputError(f"there is no tool {tool!r}; choose one of {', '.join(self.tools)}")
        self._keep()
        if self._presses():
            self._next = tool
        else:
            self._press(tool)

    def move(self, centre: ArrayLike) -> None:
        """Lead the tool to a position (3,), mm, which is kept within two extents of the body.

        Raises
        ------
        InputError
            A position that is no vector of finite numbers.
        """
        self._target = self._within(as_vector("centre", centre))

    def turn(self, rotation: ArrayLike) -> None:
        """Turn the tool further, about its centre, by a rotation vector (3,), rad.

        Raises
        ------
        InputError
            A rotation that is no vector of finite numbers.
        """
        self._rotation_target = rotation_matrix(as_vector("rotation", rotation)) @ self._rotation_target

    def aim(self, direction: ArrayLike) -> None:
        """Turn the tool until its third axis, that of a cylinder, has a direction (3,), the shortest way from where it is to be.

        Raises
        ------
        InputError
            A direction that is no vector of finite numbers, or has no length.
        """
        wanted = as_vector("direction", direction)
        length = require_positive("length of the direction", float(np.linalg.norm(wanted)))
        if self._tool:
            axis = self.tools[self._tool].geometry.axes[2] @ self._rotation_target.T
            self._rotation_target = rotation_between(axis, wanted / length) @ self._rotation_target

    def grip(self, node: int, radius_mm: float = 0.0) -> None:
        """Grip a node of the surface, and those around it within a radius at rest, mm, to pull them.

        Raises
        ------
        InputError
            There is no such node.
        """
        if not 0 <= node < len(self.body.points):
            raise InputError(f"node is {node}; the body has nodes 0 to {len(self.body.points) - 1}")
        self._keep()
        near = np.linalg.norm(self.body.points - self.body.points[node], axis=1) <= max(radius_mm, 0.0)
        near[node] = True
        self._nodes, self._gripped = np.intersect1d(np.flatnonzero(near), self._surface).astype(np.int64), node
        self._pull_target, self._under_way = self._session.positions([node])[0], None
        self._grip_hand.stop()
        self.body.grip(self._session, self._nodes)

    def pull(self, position: ArrayLike) -> None:
        """Lead the gripped node to a position (3,), mm.

        Raises
        ------
        InputError
            A position that is no vector of finite numbers.
        """
        self._pull_target = self._within(as_vector("position", position))

    def release(self) -> None:
        """Let go of gripped nodes."""
        if self._gripped >= 0:
            self._nodes, self._gripped, self._under_way = NO_NODES, -1, None
            self.body.grip(self._session, NO_NODES)

    def reset(self) -> None:
        """Put the body at rest, and the tool where it waits."""
        self._keep()
        self._begin(self.body)
        self._press(self._tool)
        self._last = self._frame(self._last.number + 1, 0.0, np.zeros(3), np.zeros(3), "")

    def cut(self, edges: ArrayLike, distance_mm: float | None = None) -> VolumeCut | LatticeCut:
        """Cut the body along the surface between successive positions of a blade's edge; finite elements come to balance behind it.

        Parameters
        ----------
        edges : array_like, shape (p, e, 3)
            See `naibu.meshing.swept_blade`, mm.
        distance_mm : float, optional
            See `naibu.meshing.cut_volume`; by default the mean edge of a mesh, and what the cubes of a lattice have.

        Raises
        ------
        InputError
            What `swept_blade`, `naibu.meshing.cut_volume` and `naibu.simulation.cut_lattice` refuse; the body is then as it was.
        """
        body, state, found = cut_in_balance(self.body, self._session, swept_blade(edges), distance_mm)
        self._keep()
        self._go_on(body, state)
        return found

    def begin_cut(self, edges: ArrayLike, distance_mm: float | None = None) -> None:
        """Cut the body as `cut` does, where it is now; finite elements move on, whole, until the cut is ready and `finish_cut` is called.

        Raises
        ------
        InputError
            A cut that is under way already, or what `cut` refuses of the blade.
        """
        if not isinstance(self.body, FiniteElementBody):
            self.cut(edges, distance_mm)
            return
        if self._cutting is not None:
            raise InputError("a cut is under way; wait until it opens")
        cutting = BackgroundCut(self.body)
        cutting.begin(self.body.without_contact(self._session.state()), swept_blade(edges), distance_mm)
        self._cutting = cutting
        if self._presses() and self._next is None:
            self._next = self._tool

    def finish_cut(self, *, wait: bool = False) -> bool:
        """Go on with the body behind the cut that was begun; False where none is ready, as while a tool that presses the body leaves it.

        Parameters
        ----------
        wait : bool
            Whether to wait for it; frames are taken until a tool that presses the body has left it, or cannot.

        Raises
        ------
        InputError
            What `cut` refuses, another body than the one that was cut, or a tool that did not leave the body, for a cut or for another
            tool; the body is then as it was.
        """
        cutting = self._cutting
        if cutting is not None and wait:
            cutting.wait()
            while self._next is not None:
                self.advance()
        if self._trapped and (cutting is None or cutting.finished):
            said, self._trapped, self._cutting = self._trapped, "", None
            raise InputError(said)
        if cutting is None or not cutting.finished or self._next is not None:
            return False
        self._cutting = None
        if cutting.body is not self.body:
            raise InputError("the cut came to nothing, as the one before it was undone meanwhile; cut again")
        body, state = cutting.result(self.body.without_contact(self._session.state()))
        self._keep()
        self._go_on(body, state)
        return True

    def _go_on(self, body: InteractiveBody, state: Any) -> None:
        """Go on with a body that was cut."""
        self._topology += 1
        self._begin(body, state)
        self._press(self._tool)
        self._last = self._frame(self._last.number + 1, self._last.time_s, np.zeros(3), np.zeros(3), "")

    def undo(self) -> bool:
        """Return to the state before the last grip, cut, change of tool or reset; False where there is none left."""
        if not self._kept:
            return False
        kept = self._kept.pop()
        self._topology += kept.body is not self.body
        self._begin(kept.body, kept.body.without_contact(kept.state))
        self._press(kept.tool)
        if kept.tool:
            self._session.restore(kept.state)
            self._centre = self._target = kept.centre
            self._rotation = self._rotation_target = kept.rotation
        self._last = self._frame(self._last.number + 1, kept.time_s, np.zeros(3), np.zeros(3), "")
        return True

    def advance(self) -> Frame:
        """Take the steps of one frame, and return it; a step that fails is taken back, and the frame says why.

        Where the next one fails too, the body is stopped where it was, and the frame says so. Where that does not help, the body begins
        anew from its shape at rest, with its cuts and the tool where it waits, and the frame says so: nothing else would move again.
        A step that takes longer than the frame may goes on in the next one, with the tool's motion as it was, and shows its parts.
        """
        self._leave()
        before = None if self.body.unmoved_by_failures else self._session.state()
        duration = self.steps * self.body.step_s
        centre, spin, gripped = self._under_way or self._next_motion(duration)
        motions = self._motions((centre - self._centre) / duration, spin)
        self._under_way = None
        try:
            forces = self.body.step(self._session, self.body.grip_velocity(gripped / duration), motions, self.steps, self.budget_s)
        except ConvergenceError as error:
            before, self._failures, said = before or self._session.state(), self._failures + 1, str(error)
            if self._failures > 1:  # where it moves on to is what has no balance
                before, said = self.body.at_rest(before), f"{said}; the body was stopped where it was"
            self._session.restore(before)
            if self._failures > PATIENCE:
                said = f"{error}; the body was put back into its shape at rest"
                self._begin(self.body)
                self._press(self._tool)
            self._target, self._rotation_target = self._centre, self._rotation
            self._pull_target = self._grip_position()
            self._tool_hand.stop()
            self._grip_hand.stop()
            again = self._frame(self._last.number + 1, self._last.time_s, self._last.force, self._last.pull, said)
            self._last = replace(again, unbalanced=self._last.unbalanced)
            return self._last
        if forces is None:
            self._under_way = (centre, spin, gripped)
            midway = self._session.positions_midway if isinstance(self._session, DividedSession) else None
            self._last = self._last.of_a_step_under_way(midway)
            return self._last
        way, self._failures = centre - self._centre, 0
        self._centre = centre
        if spin.any():
            self._rotation = rotation_matrix(duration * spin) @ self._rotation
        force = forces.indenters[:, -1].mean(axis=0) if self._tool else np.zeros(3)
        pull = forces.bodies[:, 1].mean(axis=0) if self._gripped >= 0 else np.zeros(3)
        self._last = self._frame(self._last.number + 1, self._last.time_s + duration, force, pull, "")
        self._held.observe(self._last.positions, centre, way, force)
        return self._last

    def _presses(self) -> bool:
        """Whether the tool in play touches finite elements."""
        if not self._tool or not isinstance(self.body, FiniteElementBody):
            return False
        gap = placed(self.tools[self._tool], self._centre, self._rotation).gap(self._session.positions(self._surface))
        return bool(self._last.force.any() or gap.min() < 0.0)

    def _leave(self) -> None:
        """Lead a tool that is to be put away against the force that it exerts, and take the next one when it has left the body."""
        if self._next is None or self._under_way is not None:
            return
        if not self._presses():
            self._press(self._next)
            return
        self._leaving += 1
        if self._leaving * self.frame_s > LEAVING_S:
            undone = "the cut came to nothing" if self._cutting is not None else "it stays in play"
            self._trapped = f"{self._tool} did not leave the body within {LEAVING_S:g} s, and {undone}: move it out and try again"
            self._next, self._leaving, self._target = None, 0, self._centre
            return
        force = float(np.linalg.norm(self._last.force))
        away = -self._last.force / force if force else np.array([0.0, 0.0, 1.0])
        self._target = self._within(self._centre + self.extent_mm * away)

    def _next_motion(self, duration: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where the tool goes in a frame, mm, how fast it turns, rad/s, and how far gripped nodes go, mm."""
        reach, gripped, spin = self.fastest_mm_s * duration, self._grip_position(), np.zeros(3)
        centre = self._tool_hand.next_place(self._centre, self._target, duration, self.delay_s)
        pulled = self._grip_hand.next_place(gripped, self._pull_target, duration, self.delay_s)
        if self._tool:
            tool, spin = self.tools[self._tool], turning_towards(self._rotation, self._rotation_target, duration) * (not self._held.crushed)
            if self.body.fixtures:
                turned = placed(tool, centre, rotation_matrix(duration * spin) @ self._rotation)
                centre = outside_planes(self.body.fixtures, turned, centre)
            centre = towards(self._centre, centre, min(reach, farthest_in_a_step(tool) * self.steps))
            centre = self._centre + self._held.limited(self._centre, centre - self._centre)
        return centre, spin, towards(gripped, pulled, reach) - gripped

    def close(self) -> None:
        """Release what the session holds, and wait for a cut under way."""
        if self._cutting is not None:
            self._cutting.wait()
        self._session.close()

    def _begin(self, body: InteractiveBody, state: Any = None) -> None:
        """Begin a session of a body, at rest or at a state without contact, with nothing gripped and no tool."""
        if self._topology or self._kept:
            self._session.close()
        self.body, self._surface = body, np.unique(body.faces)
        self._low, self._high = body.points.min(axis=0), body.points.max(axis=0)
        self._extent = float((self._high - self._low).max())
        self._nodes, self._gripped = NO_NODES, -1
        self._held = HeldTool.by(body, self.frame_s, FRAME_S)
        self._session = body.session()
        if state is not None:
            self._session.press(())
            self._session.restore(state)

    def _motions(self, velocity: FloatArray, spin: FloatArray) -> list[IndenterVelocity]:
        still = [IndenterVelocity() for _ in self.body.fixtures]
        return [*still, IndenterVelocity(velocity, spin)] if self._tool else still

    def _press(self, tool: str) -> None:
        """Bring the fixtures and a tool, where it waits, into play."""
        state = self._session.state()
        self._session.press(())
        self._session.restore(self.body.without_contact(state))
        self._tool, self._under_way, self._next, self._leaving, self._trapped = tool, None, None, 0, ""
        self._tool_hand.stop()
        self._rotation = self._rotation_target = np.eye(3)
        if tool:
            points = self.body.kept_clear(self._session.positions())
            self._centre = self._target = waiting_place(self.tools[tool], points, 0.1 * self.extent_mm)
        own = [] if not tool else [placed(self.tools[tool], self._centre)]
        self._session.press((*self.body.fixtures, *own))

    def _grip_position(self) -> FloatArray:
        return self._pull_target if self._gripped < 0 else self._session.positions([self._gripped])[0]

    def _within(self, position: FloatArray) -> FloatArray:
        middle, reach = 0.5 * (self._low + self._high), REACH * self.extent_mm
        return np.asarray(np.minimum(np.maximum(position, middle - reach), middle + reach))

    def _keep(self) -> None:
        self._kept.append(KeptState(self.body, self._session.state(), self._last.time_s, self._tool, self._centre, self._rotation))

    def _frame(self, number: int, time_s: float, force: FloatArray, pull: FloatArray, failed: str) -> Frame:
        positions = self._session.positions()
        return Frame(
            self.body, number, time_s, positions, self._tool, self._centre, self._rotation, force, pull, self._surface,
            self.tools.get(self._tool), self._gripped, failed, self._topology, self.body.unbalanced(self._session), held=self._held.held,
        )  # fmt: skip
