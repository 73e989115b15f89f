"""A live page without a browser, frame by frame, that notes whatever must not happen: ``python tests/helpers/watched_page.py --help``."""

from __future__ import annotations

import argparse
import collections
import itertools
import sys
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]

from restless_hands import FRAME, RestlessHands  # noqa: E402  it stands beside the tests

from naibu.core.arrays import FloatArray  # noqa: E402
from naibu.core.errors import InputError  # noqa: E402
from naibu.meshing.quality import signed_volumes  # noqa: E402
from naibu.simulation import FiniteElementBody, InteractiveSimulation, LatticeBody, RealTimeLoop  # noqa: E402
from naibu.simulation.interactive_simulation import LEAVING_S  # noqa: E402
from naibu.viewer.live.commands import read_command  # noqa: E402
from naibu.viewer.live.scene import frame_bytes  # noqa: E402
from naibu.workflows import TouchableModel, tools_for  # noqa: E402
from naibu.workflows.interactive.live import BUDGET_S, DELAY_S, LiveSimulation  # noqa: E402
from naibu.workflows.interactive.touchable_models import touchable  # noqa: E402

MOST_DISPLACED = 6.0  # extents of the body; further only pieces that nothing holds
MOST_KEPT = 20
STILL = 0.02  # extents a second


@dataclass(slots=True)
class WatchedPage:
    """A model on a page, which is advanced by `frame` and told messages by `say`.

    Attributes
    ----------
    model : TouchableModel
        What is touched.
    as_live : bool
        Whether a frame leaves steps that take long to the next one, as on the page; otherwise runs are repeatable where the body is.
    failures : list of str
        What must not have happened.
    slowest_s : float
        Processor time of the slowest frame, of this thread.
    said : collections.Counter
        What the page was told of troubles.
    """

    model: TouchableModel
    as_live: bool = False
    failures: list[str] = field(init=False, default_factory=list)
    slowest_s: float = field(init=False, default=0.0)
    slow: list[tuple[float, int, str]] = field(init=False, default_factory=list)
    said: collections.Counter[str] = field(init=False, default_factory=collections.Counter)
    frames: int = field(init=False, default=0)
    left: float = field(init=False, default=0.0)  # extents, from the shape at rest, after all hands were taken away
    fastest: float = field(init=False, default=0.0)  # extents a second, of any node
    farthest: float = field(init=False, default=0.0)  # extents, of any node from where it is at rest
    page: LiveSimulation = field(init=False)
    _clock: float = field(init=False, default=0.0)
    _due: float = field(init=False, default=0.0)
    _kept: list[tuple[FloatArray, str, object]] = field(init=False, default_factory=list)
    _doing: str = field(init=False, default="")

    def __post_init__(self) -> None:
        simulation = InteractiveSimulation(self.model.body, self.model.tools or tools_for(self.model.body), delay_s=DELAY_S)
        if self.as_live:
            simulation.budget_s = BUDGET_S
        self.page = LiveSimulation(self.model, RealTimeLoop(simulation, clock=lambda: self._clock, sleep=lambda _: None))

    @property
    def simulation(self) -> InteractiveSimulation:
        """What is simulated."""
        return self.page.loop.simulation

    def close(self) -> None:
        """End it."""
        self.simulation.close()

    def say(self, message: str) -> None:
        """Tell the page a message, as its server does, and have it carried out."""
        try:
            command = read_command(message)
        except InputError:
            self.said["refused message"] += 1
            return
        self._doing = command.kind
        before = self._now()  # a cut that was prepared opens first, and keeps a state of its own
        self._obey()
        self._note_kept(before)
        before = self._now()
        self.page.command(command)
        self._obey()
        self._compare_undone(command.kind, before)
        if command.kind == "cut" and not self.as_live and self.simulation._cutting is not None:
            self.simulation._cutting.wait()  # for the run to be repeatable

    def frame(self) -> None:
        """Have the next frame made, and look at it."""
        began = time.thread_time()
        before = self._now()
        self._obey()
        self._note_kept(before)
        self._due = self.page.loop._once(self._due)
        self._clock = max(self._clock, self._due)
        took = time.thread_time() - began
        self.frames += 1
        self.slowest_s = max(self.slowest_s, took)
        if took > 1.0:
            self.slow.append((round(took, 2), self.frames, self._doing))
        self._look()

    def let_go(self, wait_s: float) -> float:
        """Take every hand away, wait, and return how far the body then is from its shape at rest, a rigid motion aside, in extents."""
        for message in (
            '{"type": "pause", "on": false}',
            '{"type": "record", "on": false}',
            '{"type": "release"}',
            '{"type": "tool", "name": ""}',
        ):
            self.say(message)
        while self.page.loop._replay:
            self.frame()
        for _ in range(round(wait_s / self.simulation.frame_s)):
            self.frame()
        last = self.simulation.last
        if last.tool and wait_s > LEAVING_S and not any("did not leave the body" in said for said in self.said):
            self._fail(f"{last.tool} did not leave, and nothing was said")
        speed = float(np.linalg.norm(self.simulation._session.state().velocity, axis=1).max()) / self.simulation.extent_mm
        if speed > STILL and not last.topology and not last.tool:
            self._fail(f"it still moves at {speed:.3g} extents a second")
        rest = last.body.points - last.body.points.mean(axis=0)
        moved = last.positions - last.positions.mean(axis=0)
        turn = np.eye(3)
        if not len(last.body.supported):
            u, _, v = np.linalg.svd(moved.T @ rest)
            turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        else:
            rest, moved = last.body.points, last.positions
        return float(np.linalg.norm(moved - rest @ turn.T, axis=1).max()) / self.simulation.extent_mm

    def _now(self) -> tuple[FloatArray, str, object, int, int]:
        simulation = self.simulation
        kept = simulation._kept
        return simulation._session.positions(), simulation.last.tool, simulation.body, len(kept), id(kept[-1]) if kept else 0

    def _obey(self) -> None:
        volume, topology = self._volume(), self.simulation.last.topology
        self.page.loop._obey()
        if self.simulation.last.topology != topology and not np.isclose(self._volume(), volume, rtol=1e-9):
            self._fail(f"volume {volume:.9g} mm3 became {self._volume():.9g}")

    def _volume(self) -> float:
        body = self.simulation.body
        if isinstance(body, FiniteElementBody):
            return float(signed_volumes(body.mesh).sum())
        assert isinstance(body, LatticeBody)
        return body.engine.lattice.total_mass

    def _note_kept(self, before: tuple[FloatArray, str, object, int, int]) -> None:
        kept = self.simulation._kept
        if kept and id(kept[-1]) != before[4] and len(kept) >= before[3]:
            self._kept = [*self._kept, before[:3]][-MOST_KEPT:]

    def _compare_undone(self, kind: str, before: tuple[FloatArray, str, object, int, int]) -> None:
        if kind != "undo":
            self._note_kept(before)
        elif self._kept:
            positions, tool, body = self._kept.pop()
            last = self.simulation.last
            if body is not last.body or tool != last.tool or len(positions) != len(last.positions):
                self._fail("undo led to another body or tool")
            elif np.abs(last.positions - positions).max() > 1e-9:
                self._fail(f"undo led {np.abs(last.positions - positions).max():.3g} mm away from where the body was")
        if len(self._kept) != len(self.simulation._kept):
            self._fail(f"{len(self.simulation._kept)} states kept, {len(self._kept)} expected")
            self._kept = self._kept[: len(self.simulation._kept)]

    def _look(self) -> None:
        frame, extent = self.page.loop.latest()[0], self.simulation.extent_mm
        if trouble := self.page.trouble():
            self.said[trouble[:80]] += 1
        for name in ("positions", "force", "pull", "tool_centre", "tool_rotation", "time_s", "unbalanced", "penetration_mm"):
            if not np.isfinite(getattr(frame, name)).all():
                self._fail(f"{name} is not finite")
        moved = float(np.linalg.norm(frame.positions - frame.body.points, axis=1).max()) / extent
        self.farthest = max(self.farthest, moved)
        self.fastest = max(self.fastest, float(np.linalg.norm(self.simulation._session.state().velocity, axis=1).max()) / extent)
        if moved > MOST_DISPLACED and not frame.topology:
            self._fail(f"the body is {moved:.3g} extents away")
        frame_bytes(self.page.frame(), True, frame.body.strain(frame.positions) if self.frames % 50 == 0 else None)

    def _fail(self, what: str) -> None:
        self.failures.append(f"frame {self.frames}, {self._doing}: {what}")


def driven(
    model: TouchableModel, seed: int, frames: int, *, cuts: bool = True, as_live: bool = False, settling_s: float = 0.0
) -> WatchedPage:
    """Return the page of a model after so many frames in the hands of a seed, closed."""
    page = WatchedPage(model, as_live)
    hands = RestlessHands(page.simulation, np.random.default_rng(seed), cuts)
    try:
        for message in itertools.takewhile(lambda _: page.frames < frames, hands.messages()):
            if message == FRAME:
                page.frame()
            else:
                page.say(message)
        page.left = page.let_go(settling_s) if settling_s else 0.0
    finally:
        page.close()
    return page


def main() -> int:
    """Drive models, and print what must not have happened."""
    from touched_models import MODELS, repeatable

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help=f"{', '.join(MODELS)}, or what naibu live takes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=5)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--settling", type=float, default=4.0)
    parser.add_argument("--no-cuts", action="store_true")
    parser.add_argument("--as-live", action="store_true")
    given = parser.parse_args()
    bad = 0
    for seed in range(given.seed, given.seed + given.count):
        began = time.process_time()
        model = MODELS[given.model]() if given.model in MODELS else repeatable(touchable(given.model))
        try:
            page = driven(model, seed, given.frames, cuts=not given.no_cuts, as_live=given.as_live, settling_s=given.settling)
        except Exception:
            traceback.print_exc()
            bad += 1
            print(f"{given.model} seed {seed}: EXCEPTION", flush=True)
            continue
        bad += bool(page.failures)
        took = time.process_time() - began
        print(
            f"{given.model} seed {seed}: {took:.1f} s, slowest frame {page.slowest_s:.2f} s {page.slow[:6]}, "
            f"topology {page.simulation.last.topology}, fastest {page.fastest:.1f}, farthest {page.farthest:.1f}, left {page.left:.2g}",
            flush=True,
        )
        print("   FAIL " + "; ".join(page.failures[:4]) if page.failures else "   ok", dict(page.said), flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
