"""What is compiled and factorized before a body is touched, and a haptic device that comes meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from naibu.simulation.haptics.haptic_loop import HapticHand
from naibu.simulation.interactive_bodies import FiniteElementBody, InteractiveBody
from naibu.simulation.interactive_simulation import FRAME_S, InteractiveSimulation
from naibu.workflows.interactive.touchable_models import tools_for

SETTLING = 6  # frames in which finite elements settle on their supports
TOUCHING = 30  # frames at most until a tool has come to the body
WAIT_S = 1e-3


def compile_for(body: InteractiveBody) -> None:
    """Compile what steps need, touched ones included: a tool comes to the body, which is then gripped, in a simulation that is dropped."""
    simulation = InteractiveSimulation(body, tools_for(body), max(FRAME_S, body.step_s))
    try:
        highest = int(body.points[:, 2].argmax())
        simulation.take(next(iter(simulation.tools)))
        simulation.move(body.points[highest])
        for _ in range(TOUCHING):
            if simulation.advance().force.any():
                break
        simulation.grip(highest, 0.0)
        simulation.advance()
    finally:
        simulation.close()


def settle(simulation: InteractiveSimulation) -> None:
    """Factorize what frames need by the first ones, in which finite elements settle on their supports."""
    if isinstance(simulation.body, FiniteElementBody):
        for _ in range(SETTLING):
            simulation.advance()


@contextmanager
def waiting_device(hand: HapticHand | None) -> Iterator[None]:
    """Within this context a device gets answers without force that say so, from a thread of their own; None where there is none."""
    if hand is None:
        yield
        return
    stop = threading.Event()

    def answer() -> None:
        before = time.perf_counter()
        while not stop.wait(WAIT_S):
            now = time.perf_counter()
            hand.idle(now - before)
            before = now

    thread = threading.Thread(target=answer, name="naibu haptics, waiting", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
