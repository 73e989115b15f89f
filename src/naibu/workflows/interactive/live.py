"""Touch a body in the browser: push it, pull it and look inside while it is simulated."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.simulation.cuts.background_cut import CUT_STAGES
from naibu.simulation.frame import Frame
from naibu.simulation.haptics.haptic_loop import LONGEST_STEP_S, HapticHand
from naibu.simulation.haptics.haptic_thread import HapticThread
from naibu.simulation.haptics.local_contact import LocalContact
from naibu.simulation.interactive_bodies import FiniteElementBody, InteractiveBody
from naibu.simulation.interactive_simulation import FRAME_S, InteractiveSimulation
from naibu.simulation.real_time_loop import RealTimeLoop
from naibu.simulation.tool_places import placed
from naibu.viewer.live.commands import LiveCommand
from naibu.viewer.live.scene import FAILED, HELD, PAUSED, PREPARING, RECORDING, REPLAYING, UNDER_WAY, LiveFrame, LiveScene
from naibu.viewer.live.server import LiveServer, bound_port, serve
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, motion_html
from naibu.workflows.applications.fingertip_study import FINGERTIP, describes_fingertip
from naibu.workflows.interactive.cut_kernels import CutKernels
from naibu.workflows.interactive.haptics.endpoint import HapticEndpoint
from naibu.workflows.interactive.preparation import compile_for, settle, waiting_device
from naibu.workflows.interactive.touchable_fingertip import touchable_fingertip
from naibu.workflows.interactive.touchable_models import MeshMaterial, TouchableModel, tools_for, touchable
from naibu.workflows.markers.experiments import Source

GRIP_RADIUS = 0.08  # of the extent of the body
PAGE_BYTES = 5_000_000
BUDGET_S = 0.014  # of the processor for a frame: a step that takes longer goes on in the next one
DELAY_S = 0.06  # with which tool and grip follow a mouse, which browsers tell once a picture
SWITCH_S = 2e-4  # in which the page leaves the interpreter to the physics of a haptic device


@dataclass(slots=True, eq=False)
class LiveSimulation:
    """The source of the live page: a loop with its scene."""

    model: TouchableModel
    loop: RealTimeLoop
    cut_kernels: CutKernels | None = None
    _scene: LiveScene | None = None

    @property
    def scene(self) -> LiveScene:
        """What is drawn; another one after a cut."""
        frame = self.loop.latest()[0]
        if self._scene is None or self._scene.topology != frame.topology:
            self._scene = self._made_scene(frame.body, frame.topology)
        return self._scene

    def _made_scene(self, body: InteractiveBody, topology: int) -> LiveScene:
        tools = self.loop.simulation.tools
        whole = body is self.model.body  # also behind Undo: the numbers of nodes that markers refer to
        return LiveScene(
            self.model.title, self.model.sentences, body.points, body.faces, body.cells,
            [_shape(name, tool) for name, tool in tools.items()],
            [_shape(f"support {k + 1}", fixture) for k, fixture in enumerate(body.fixtures)],
            np.array([f.centre for f in body.fixtures], dtype=float).reshape(-1, 3),
            self.model.strain, self.loop.simulation.frame_s, self.model.marker_nodes[: None if whole else 0],
            self.model.marker_weights[: None if whole else 0], topology, cuttable=self.model.cuttable,
            readings=() if self.model.sensor is None else self.model.sensor.readings, cut_stages=CUT_STAGES,
            cautions=[body.caution(f"the {name}", tool) for name, tool in tools.items()],
            grip_caution=body.caution("the pull", None),
        )  # fmt: skip

    @property
    def number(self) -> int:
        """Number of the last frame."""
        return self.loop.latest()[0].number

    def frame(self) -> LiveFrame:
        """Return the last frame."""
        frame, pace = self.loop.latest()
        flags = PAUSED * pace.paused | RECORDING * pace.recording | REPLAYING * pace.replaying | FAILED * bool(frame.failed)
        flags |= HELD * frame.held | UNDER_WAY * frame.under_way | PREPARING * self._preparing
        tool = list(self.loop.simulation.tools).index(frame.tool) if frame.tool else -1
        return LiveFrame(
            frame.number, frame.time_s, frame.positions, tool, frame.gripped, frame.tool_centre, frame.force, frame.pull,
            frame.penetration_mm, frame.indentation_mm, pace.steps_per_s, pace.real_time, flags,
            lambda: frame.body.strain(frame.positions), frame.topology, frame.unbalanced,
            tuple(Rotation.from_matrix(frame.tool_rotation).as_quat().tolist()), pace.cut_stage,
            np.zeros((0, 3)) if self.model.sensor is None else self.model.sensor.at(frame),
        )  # fmt: skip

    @property
    def _preparing(self) -> bool:
        return self.cut_kernels is not None and not self.cut_kernels.ready

    def command(self, command: LiveCommand) -> None:
        """Carry out a command of the page that drives."""
        loop = self.loop
        match command.kind:
            case "cut" if self._preparing:
                loop.submit(_refuse_cut)
            case "cut" | "grip" if loop.replaying:
                loop.submit(_refuse_while_replaying)
            case "pause":
                loop.pause(command.switch)
            case "record":
                loop.record(command.switch)
            case "replay":
                loop.replay()
            case kind:
                loop.submit(_order(kind, command, self.model))

    def trouble(self) -> str:
        """Return what was wrong with the last command that failed, once."""
        return self.loop.trouble()

    def recording_html(self) -> str:
        """Return the recorded motion as a page.

        Raises
        ------
        InputError
            Nothing is recorded.
        """
        recorded = self.loop.recorded()
        frames = tuple(f for f in recorded if f.topology == recorded[-1].topology)  # a page shows one surface: that of the end
        if len(frames) < 2:
            raise InputError("nothing is recorded; press Record, touch the body, press Stop, and save again")
        return motion_html(self._page(frames), PAGE_BYTES)

    def _page(self, frames: tuple[Frame, ...]) -> MotionPage:
        body = frames[-1].body
        nodes, faces = np.unique(body.faces, return_inverse=True)
        moved = np.stack([frame.positions[nodes] for frame in frames]) - body.points[nodes]
        times = np.array([frame.time_s for frame in frames]) - frames[0].time_s
        last = next((frame.tool for frame in reversed(frames) if frame.tool), "")
        turn = next((frame.tool_rotation for frame in reversed(frames) if frame.tool), np.eye(3))
        shapes = [_shape(last, placed(self.loop.simulation.tools[last], np.zeros(3), turn))] if last else []
        turned = any(frame.tool and not np.allclose(frame.tool_rotation, turn) for frame in frames)
        told = ("Recorded from the live page.", *(["The tool is drawn as it was turned at the end."] if turned else []))
        centres = np.array([[frame.tool_centre] if last else [] for frame in frames]).reshape(len(frames), len(shapes), 3)
        force = np.array([[frame.force] if last else [] for frame in frames]).reshape(len(frames), len(shapes), 3)
        return MotionPage(
            self.model.title, [*self.model.sentences, *told], times, faces.reshape(-1, 3), body.points[nodes],
            moved, [ColourField("displacement, mm", np.linalg.norm(moved, axis=2))], shapes, centres, times, force,
        )  # fmt: skip


def live(
    source: str | os.PathLike[str],
    *,
    experiment: Source | None = None,
    material: MeshMaterial | None = None,
    port: int = 8765,
    haptics_port: int | None = None,
    decoder: str | os.PathLike[str] | None = None,
    lips_friction: float = 0.0,
    preparing: Callable[[], None] | None = None,
    ready: Callable[[str], None],
) -> None:
    """Serve the live page of a model until Ctrl-C.

    Parameters
    ----------
    source : str or path-like
        ``"fingertip"`` or the file of one; or see `naibu.workflows.interactive.touchable_models.touchable`.
    experiment : path, str or Experiment, optional
        Whose body an identified model is made for; by default the first one that it was identified from.
    material : MeshMaterial, optional
        Of a mesh.
    port : int
        Of the loopback interface; 0 takes a free one.
    haptics_port : int, optional
        UDP port of the loopback interface for a haptic device, which then leads the tool.
    decoder : path-like, optional
        Of a fingertip: ``NAME-decoder.json`` of its simulation.
    lips_friction : float
        Coulomb's coefficient between the two sides of a cut, of finite elements.
    preparing : callable, optional
        Called before kernels are compiled and factors made, which takes a minute on a first run. From then on a haptic device is
        answered, without force until all is ready.
    ready : callable
        Called with the address of the page once it can be opened.

    Raises
    ------
    InputError
        A source that cannot be used, a port that is taken, or friction of a body whose sides of cuts do not touch each other.
    """
    if not (np.isfinite(lips_friction) and lips_friction >= 0.0):
        raise InputError(f"lips_friction must be a finite number that is not negative, not {lips_friction:g}; 0 is frictionless")
    if not 0 <= port <= 65535:
        raise InputError(f"port must lie between 0 and 65535, not {port}")
    if haptics_port is not None and not 1 <= haptics_port <= 65535:
        raise InputError(f"haptics_port must lie between 1 and 65535, not {haptics_port}")
    if Path(source).suffix and not Path(source).exists():
        _touchable(source, experiment, material, decoder)  # says so, before anything is prepared
    with bound_port(port) as bound, _haptic_hand(haptics_port) as hand:
        with waiting_device(hand):
            if preparing is not None:
                preparing()
            model = _rubbing(_touchable(source, experiment, material, decoder), lips_friction)
            simulation = _prepared(model, hand)
            kernels = _cut_kernels(model, lips_friction)
            if kernels is not None and hand is not None:
                kernels.wait()  # a device feels what takes the interpreter from its thread
        with _stepped(simulation, hand) as loop:
            serve(LiveServer(LiveSimulation(model, loop, kernels)), bound, ready)


def _touchable(
    source: str | os.PathLike[str], experiment: Source | None, material: MeshMaterial | None, decoder: str | os.PathLike[str] | None
) -> TouchableModel:
    if not describes_fingertip(source):
        if decoder is not None:
            raise InputError(f"`decoder` goes with a fingertip, and {source} is none; leave it out, or name {FINGERTIP} or the file of one")
        return touchable(source, experiment=experiment, material=material)
    if experiment is not None:
        raise InputError(f"`experiment` goes with an identified model, and {source} is a fingertip; leave it out")
    if material is not None:
        raise InputError(f"material goes with a mesh, and {source} is a fingertip, whose file tells its gel; leave it out")
    return touchable_fingertip(source, decoder)


def _rubbing(model: TouchableModel, friction: float) -> TouchableModel:
    """Return the model whose sides of cuts to come rub on each other; the same where there is no friction."""
    if friction == 0.0:
        return model
    if not (model.cuttable and isinstance(model.body, FiniteElementBody)):
        raise InputError(f"lips_friction must be 0, not {friction:g}: this is no body of finite elements that can be cut")
    return replace(model, body=replace(model.body, lips_friction=friction))


def _cut_kernels(model: TouchableModel, lips_friction: float) -> CutKernels | None:
    """Begin to compile what cuts of a model need; None where there is nothing to compile."""
    return CutKernels(lips_friction) if model.cuttable and isinstance(model.body, FiniteElementBody) else None


@contextmanager
def touched_loop(model: TouchableModel, haptics_port: int | None = None) -> Iterator[RealTimeLoop]:
    """Simulate a model in a thread of its own, with an endpoint for a haptic device at a port, until the context ends.

    Kernels are compiled before; a device that comes meanwhile gets answers without force.

    Raises
    ------
    InputError
        A port that is taken.
    """
    with _haptic_hand(haptics_port) as hand:
        with waiting_device(hand):
            simulation = _prepared(model, hand)
        with _stepped(simulation, hand) as loop:
            yield loop


@contextmanager
def _haptic_hand(port: int | None) -> Iterator[HapticHand | None]:
    """The hand of a device that may come to a port; None where there is none."""
    if port is None:
        yield None
        return
    with HapticEndpoint(port) as endpoint:
        yield HapticHand(endpoint)


def _prepared(model: TouchableModel, hand: HapticHand | None) -> InteractiveSimulation:
    """Return the simulation of a model, all compiled and factorized; its frames are single steps where a device can feel them."""
    body = model.body
    with threadpool_limits(1, user_api="blas"):
        compile_for(body)
        simulation = InteractiveSimulation(body, model.tools or tools_for(body), body.step_s if _single(body, hand) else FRAME_S)
        settle(simulation)
    return simulation


@contextmanager
def _stepped(simulation: InteractiveSimulation, hand: HapticHand | None) -> Iterator[RealTimeLoop]:
    """Step a simulation in a thread of its own, and serve a device, until the context ends."""
    single = _single(simulation.body, hand)
    simulation.budget_s, simulation.delay_s = BUDGET_S, DELAY_S if hand is None else 0.0
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1, user_api="blas"))  # threads of small matrices wait for one another where cores are busy
        stack.callback(gc.unfreeze)
        gc.collect()
        gc.freeze()  # a collection over all that was imported takes more than 5 ms, and once the thread that steps took 100 ms for it
        if hand is not None:
            stack.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(SWITCH_S)
        loop = stack.enter_context(RealTimeLoop(simulation, hand=hand if single else None))
        if hand is not None and not single:
            contact = LocalContact(simulation.tools, simulation.fastest_mm_s, body_step_s=simulation.frame_s)
            stack.enter_context(HapticThread(loop, hand, contact))
        yield loop


def _single(body: InteractiveBody, hand: HapticHand | None) -> bool:
    """Whether frames are single steps of the body, which are short enough to be felt."""
    return hand is not None and body.step_s <= LONGEST_STEP_S


def _refuse_cut(_: InteractiveSimulation) -> None:
    raise InputError("kernels of cuts are still being compiled, which the first run does; cut when that is done")


def _refuse_while_replaying(_: InteractiveSimulation) -> None:
    raise InputError("the recording is being shown, whose body may not be the one that is simulated; pull and cut when it has ended")


def _order(kind: str, command: LiveCommand, model: TouchableModel) -> Callable[[InteractiveSimulation], None]:
    """Return what a command does to the simulation."""

    def carry_out(simulation: InteractiveSimulation) -> None:
        match kind:
            case "tool":
                simulation.take(command.name)
            case "move":
                simulation.move(command.vector)
                if model.aimed_at is not None:
                    simulation.aim(np.subtract(model.aimed_at, command.vector))
            case "turn":
                simulation.turn(command.vector)
            case "grip":
                simulation.grip(command.number, GRIP_RADIUS * simulation.extent_mm)
            case "pull":
                simulation.pull(command.vector)
            case "release":
                simulation.release()
            case "reset":
                simulation.reset()
            case "undo":
                simulation.undo()
            case "cut" if not model.cuttable:
                raise InputError(f"{model.title}: this body is not cut; touch it")
            case "cut":
                simulation.begin_cut(command.edges)

    return carry_out


def _shape(name: str, indenter: RigidIndenter) -> RigidShape:
    geometry = indenter.geometry
    return RigidShape(name, geometry.name, np.asarray(geometry.size), np.asarray(geometry.axes))
