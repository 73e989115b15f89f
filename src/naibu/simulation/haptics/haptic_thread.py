"""A thread that serves a haptic device a thousand times a second beside a body whose steps take longer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

from naibu.simulation.haptics.haptic_loop import HapticHand
from naibu.simulation.haptics.local_contact import LocalContact
from naibu.simulation.haptics.thread_priority import REST, scheduled_first
from naibu.simulation.interactive_simulation import InteractiveSimulation
from naibu.simulation.real_time_loop import RealTimeLoop

BEHIND_S = 0.02  # a delay that is not caught up with


@dataclass(slots=True, eq=False)
class HapticThread:
    """Lead the tool of a loop by a device, through a local model of the contact; use it as a context manager within that of the loop.

    Attributes
    ----------
    loop : RealTimeLoop
        That steps the body.
    hand : HapticHand
        To the device.
    contact : LocalContact
        What the device feels between the steps of the body.
    clock, sleep : callable
        Time and waiting, s.
    """

    loop: RealTimeLoop
    hand: HapticHand
    contact: LocalContact
    clock: Callable[[], float] = time.perf_counter
    sleep: Callable[[float], None] = time.sleep
    _stop: threading.Event = field(init=False, default_factory=threading.Event)
    _thread: threading.Thread | None = field(init=False, default=None)

    def __enter__(self) -> Self:
        """Start the thread."""
        self._thread = threading.Thread(target=self._run, name="naibu haptics", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop it."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            with scheduled_first():
                woke = due = self.clock()
                while not self._stop.is_set():
                    now = self.clock()
                    wait = due - now
                    self.sleep(max(wait, REST * (now - woke)))
                    woke = self.clock()
                    if wait < -BEHIND_S:
                        due = self.clock()
                    self.step()
                    due += self.contact.frame_s
        except BaseException as failure:
            error = failure

            def fail(_: InteractiveSimulation) -> None:
                raise error

            self.loop.submit(fail)  # the loop tells it

    def step(self) -> None:
        """Serve the device once."""
        frame, pace = self.loop.latest()
        if pace.paused or pace.replaying:
            self.hand.idle(self.contact.frame_s)
            return
        orders = self.contact.observe(frame, led=self.hand.leading)
        self.hand.before(self.contact)
        reached = self.contact.advance()
        self.hand.after(reached, self.contact.frame_s)
        if self.hand.leading:
            for order in orders:
                self.loop.submit(order)
