"""Frames a second and delay of the live page in headless Chromium with software rendering, for surfaces of several sizes.

A server shows a sphere that breathes 60 times a second, as a simulation would; the page draws it. Printed are frames drawn a
second, and the time from a command of the page (the tool is moved) to the picture that shows its effect.

Run: ``python benchmarks/live_page.py [--vertices 5000 50000] [--seconds 5] [--record]``
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import uvicorn
from records import ResultTable, write_record

from naibu.core.arrays import FloatArray, IntArray
from naibu.viewer.live.commands import LiveCommand
from naibu.viewer.live.scene import LiveFrame, LiveScene
from naibu.viewer.live.server import LONGEST_MESSAGE, LiveServer
from naibu.viewer.motion_page import RigidShape

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from browser import opened_browser

RADIUS = 40.0
COLUMNS = ("vertices", "frames drawn a second", "delay, median, ms", "delay, 95 %, ms")
COUNTED = """(async () => {
  const frames = () => naibuLive.view.renderer.info.render.frame;
  const [began, first] = [performance.now(), frames()];
  await new Promise((done) => setTimeout(done, %d));
  return 1000 * (frames() - first) / (performance.now() - began);
})()"""
DELAY = """(async () => {
  const height = 60 + 10 * Math.random();
  const began = performance.now();
  naibuLive.command("move", { at: [0, 0, height] });
  while (Math.abs(naibuLive.frame.centre[2] - height) > 1e-3) await new Promise((done) => requestAnimationFrame(done));
  await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)));
  return performance.now() - began;
})()"""


def sphere(vertices: int) -> tuple[FloatArray, IntArray]:
    """Points and triangles of a sphere of about as many vertices, by meridians and parallels."""
    rings = max(8, round(np.sqrt(vertices / 2.0)))
    round_ = 2 * rings
    theta, phi = np.meshgrid(np.linspace(0.02, np.pi - 0.02, rings), np.arange(round_) * np.pi / rings, indexing="ij")
    points = RADIUS * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=2).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings - 1), np.arange(round_), indexing="ij"))
    a, b = round_ * i + j, round_ * i + (j + 1) % round_
    return points, np.concatenate([np.stack([a, a + round_, b], axis=1), np.stack([b, a + round_, b + round_], axis=1)])


@dataclass(slots=True)
class Breathing:
    """A source of frames that come 60 times a second."""

    scene: LiveScene
    began: float = field(default_factory=time.monotonic)
    centre: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 60.0]))

    def frame(self) -> LiveFrame:
        number = int(60.0 * (time.monotonic() - self.began))
        size = 1.0 + 0.05 * np.sin(0.1 * number)
        none = np.zeros(3)
        return LiveFrame(
            number,
            number / 60.0,
            size * self.scene.points,
            0,
            -1,
            self.centre,
            none,
            none,
            0.0,
            60.0,
            1.0,
            0,
            lambda: self.scene.points[:, 0],
        )

    def command(self, command: LiveCommand) -> None:
        if command.kind == "move":
            self.centre = np.array(command.vector)

    def trouble(self) -> str:
        return ""

    def recording_html(self) -> str:
        return ""


def measured(vertices: int, seconds: float, moves: int) -> tuple[int, float, int, int]:
    """A row of the table."""
    points, faces = sphere(vertices)
    ball = RigidShape("sphere", "sphere", np.array([8.0, 0.0, 0.0]), np.eye(3))
    scene = LiveScene("Breathing", [], points, faces, np.zeros((0, 4), np.int64), [ball], [], np.zeros((0, 3)), "strain, %", 1.0 / 60.0)
    live = LiveServer(Breathing(scene), "token")
    bound = uvicorn.Config(live.app(0), host="127.0.0.1", port=0, log_level="critical").bind_socket()
    port = bound.getsockname()[1]
    server = uvicorn.Server(
        uvicorn.Config(live.app(port), log_level="critical", lifespan="off", ws="websockets-sansio", ws_max_size=LONGEST_MESSAGE)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
    thread.start()
    try:
        with opened_browser() as page:
            page.open(f"http://127.0.0.1:{port}/?token=token")
            page.wait("document.querySelector('.stage[data-ready]') !== null", 60)
            rate = page.value(COUNTED % int(1e3 * seconds))
            delays = np.array([page.value(DELAY) for _ in range(moves)])
    finally:
        server.should_exit = True
        thread.join(timeout=10)
    return len(points), round(rate, 1), round(float(np.median(delays))), round(float(np.quantile(delays, 0.95)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vertices", type=int, nargs="+", default=[5_000, 50_000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--moves", type=int, default=60)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    rows = []
    for vertices in given.vertices:
        rows.append(measured(vertices, given.seconds, given.moves))
        print("  ".join(f"{name} {value}" for name, value in zip(COLUMNS, rows[-1], strict=True)), flush=True)
    if given.record:
        write_record("live_page", [ResultTable("live_page", COLUMNS, tuple(rows))])


if __name__ == "__main__":
    main()
