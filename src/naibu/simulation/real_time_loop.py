"""A thread that advances an interactive simulation at the pace of the clock, and takes commands from other threads."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field

from naibu.core.errors import NaibuError
from naibu.simulation.frame import Frame
from naibu.simulation.haptics.haptic_loop import HapticHand, require_haptic_steps
from naibu.simulation.haptics.thread_priority import REST, scheduled_first
from naibu.simulation.interactive_simulation import FRAME_S, InteractiveSimulation

MEMORY_S = 1.0  # over which rates are averaged
BEHIND_S = 0.1  # a delay that is not caught up with
RECORD_EVERY_S = 1.0 / 30.0
LONGEST_RECORD_S = 60.0

Command = Callable[[InteractiveSimulation], None]


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """How the loop keeps up.

    Attributes
    ----------
    steps_per_s : float
        Steps of the simulation a second of the clock.
    real_time : float
        Simulated seconds a second of the clock: 1 where real time is held.
    paused : bool
        Whether the loop waits.
    recording, replaying : bool
        Whether frames are being kept, or shown again.
    cut_stage : int
        Number in `naibu.simulation.cuts.background_cut.CUT_STAGES` of what is being done for a cut; -1 where none is under way.
    """

    steps_per_s: float
    real_time: float
    paused: bool
    recording: bool
    replaying: bool
    cut_stage: int = -1


@dataclass(slots=True, eq=False)
class RealTimeLoop:
    """Advance a simulation in a thread of its own; use it as a context manager.

    Attributes
    ----------
    simulation : InteractiveSimulation
        What is advanced; only the thread touches it while it runs.
    clock, sleep : callable
        Time and waiting, s.
    hand : HapticHand, optional
        A haptic device that leads the tool; frames are then single steps, of which one is shown every 1/60 s, and the thread is scheduled
        first where the system permits it (`naibu.simulation.haptics.thread_priority.scheduled_first`).

    Raises
    ------
    InputError
        With a device, frames of more than one step, or too long ones.
    """

    simulation: InteractiveSimulation
    clock: Callable[[], float] = time.perf_counter
    sleep: Callable[[float], None] = time.sleep
    hand: HapticHand | None = None
    _commands: deque[Command] = field(init=False, default_factory=deque)
    _stop: threading.Event = field(init=False, default_factory=threading.Event)
    _thread: threading.Thread | None = field(init=False, default=None)
    _latest: Frame = field(init=False)
    _pace: Pace = field(init=False, default=Pace(0.0, 0.0, False, False, False))
    _finished: deque[tuple[float, float]] = field(init=False, default_factory=deque)
    _paused: bool = field(init=False, default=False)
    _recording: bool = field(init=False, default=False)
    _record: list[Frame] = field(init=False, default_factory=list)
    _replay: deque[Frame] = field(init=False, default_factory=deque)
    _shows_recorded: bool = field(init=False, default=False)
    _trouble: str = field(init=False, default="")
    _failure: BaseException | None = field(init=False, default=None)
    _shown: float = field(init=False, default=float("-inf"))
    _woke: float = field(init=False, default=0.0)  # when a step for a device began
    _under_way: bool = field(init=False, default=False)  # whether the last frame left its step to the next one, which is due at once

    def __post_init__(self) -> None:
        if self.hand is not None:
            require_haptic_steps(self.simulation)
        self._latest = self.simulation.last

    def __enter__(self) -> RealTimeLoop:
        """Start the thread."""
        self._thread = threading.Thread(target=self._run, name="naibu physics", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread and close the simulation."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self.simulation.close()

    def submit(self, command: Command) -> None:
        """Hand over a command, which is carried out before the next frame."""
        self._commands.append(command)

    def latest(self) -> tuple[Frame, Pace]:
        """Return the last frame, and how the loop keeps up.

        Raises
        ------
        BaseException
            What ended the thread.
        """
        if self._failure is not None:
            raise self._failure
        return self._latest, self._pace

    def trouble(self) -> str:
        """Return what was wrong with the last command or step that failed, once."""
        said, self._trouble = self._trouble, ""
        return said

    def pause(self, on: bool) -> None:
        """Pause or go on."""
        self._paused = on

    def record(self, on: bool) -> None:
        """Begin a new recording, of at most a minute, or end it."""
        if on and not self._recording:
            self._record = []
        self._recording = on

    def recorded(self) -> tuple[Frame, ...]:
        """Return the frames of the recording, 30 a second."""
        return tuple(self._record)

    @property
    def replaying(self) -> bool:
        """Whether the recording is being shown, whose body may be that before a cut."""
        return bool(self._replay)

    def replay(self) -> None:
        """Show the recording again; the simulation waits meanwhile, and is shown where it is behind it."""
        self._recording = False
        self._replay = deque(self._record)

    def _run(self) -> None:
        try:
            with nullcontext() if self.hand is None else scheduled_first():
                self._woke = due = self.clock()
                while not self._stop.is_set():
                    self._obey()
                    due = self._once(due)
        except BaseException as error:
            self._failure = error

    def _once(self, due: float) -> float:
        """Make or show one frame when it is due, and return when the next one is."""
        now = self.clock()
        wait = due - now
        if self.hand is not None:
            self.sleep(max(wait, REST * (now - self._woke)))
            self._woke = self.clock()
        elif wait > 0.0:
            self.sleep(wait)
        if wait < -BEHIND_S:
            due = self.clock()
        pause = self.simulation.frame_s
        waits = self._paused or bool(self._replay)
        if self._replay and (self.hand is None or due >= self._shown + RECORD_EVERY_S):
            self._latest, self._shown, self._shows_recorded = self._replay.popleft(), due, True
            pause = RECORD_EVERY_S if self.hand is None else pause
        elif not waits:
            self._shows_recorded = False
            self._advance(due)
        elif self._shows_recorded and not self._replay:
            self._show_simulation()
        if self.hand is not None and waits:
            self.hand.idle(pause)
        if self.hand is None or waits or self._shown == due:
            self._pace = self._measured()
        return due if not waits and self._under_way else due + pause

    def _advance(self, due: float) -> None:
        """Make a frame, and show it unless a device steps faster than frames are shown."""
        simulation, hand = self.simulation, self.hand
        if hand is not None:
            hand.before(simulation)
        frame = simulation.advance()
        self._under_way, self._trouble = frame.under_way, frame.failed or self._trouble
        if hand is not None:
            hand.after(frame, simulation.frame_s)
        self._finished.append((self.clock(), 0.0 if frame.failed or frame.under_way else simulation.frame_s))
        if hand is None or frame.failed or due >= self._shown + FRAME_S:
            self._latest, self._shown = frame, due
            self._keep(frame)

    def _obey(self) -> None:
        try:
            if self.simulation.finish_cut():
                self._show_simulation()
        except NaibuError as error:
            self._trouble = str(error)
        while self._commands:
            try:
                self._commands.popleft()(self.simulation)
            except NaibuError as error:
                self._trouble = str(error)
            self._show_simulation()

    def _show_simulation(self) -> None:
        """Show the simulation where it is, unless the recording is being shown."""
        if not self._replay:
            self._latest, self._shows_recorded = self.simulation.last, False

    def _keep(self, frame: Frame) -> None:
        if not self._recording or (
            self._record and frame.time_s - self._record[-1].time_s < RECORD_EVERY_S - 0.5 * self.simulation.frame_s
        ):
            return
        self._record.append(frame)
        self._recording = len(self._record) < LONGEST_RECORD_S / RECORD_EVERY_S

    def _measured(self) -> Pace:
        now = self.clock()
        while self._finished and now - self._finished[0][0] > MEMORY_S:
            self._finished.popleft()
        span = max(now - self._finished[0][0], self.simulation.frame_s) if len(self._finished) > 1 else 0.0
        simulated = sum(length for _, length in list(self._finished)[1:])
        ratio = simulated / span if span else 0.0
        steps = ratio * self.simulation.steps / self.simulation.frame_s
        return Pace(steps, ratio, self._paused, self._recording, self.replaying, self.simulation.cut_stage)
