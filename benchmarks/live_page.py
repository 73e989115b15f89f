"""Frames a second and delay of the live page in headless Chromium with software rendering, for surfaces of several sizes.

A server shows a sphere that breathes 60 times a second, as a simulation would; the page draws it, with the finest picture that
there is time for. Printed are vertices and pixels (a side, for one of the screen) that are drawn in motion, frames drawn a second, the
same while a hand leads the tool in a circle and the camera goes round the body, the processor time of the browser's processes for a frame
of that motion, and the time from a command of the page (the tool is moved) to the animation frame after the one that drew its effect: the
browser has composed the picture then. Chromium is started as on a computer without a graphics card, where it draws WebGL with SwiftShader
and composes the page itself.

Run: ``python benchmarks/live_page.py [--vertices 5000 50000] [--seconds 5] [--record]``
"""

from __future__ import annotations

import argparse
import os
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
from naibu.viewer.live.server import LiveServer, web_server
from naibu.viewer.motion_page import RigidShape

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from browser import OPTIONS, opened_browser

RADIUS = 40.0
COLUMNS = (
    "vertices", "drawn in motion", "pixels a side", "frames drawn a second", "in circles", "processor ms a frame",
    "delay, median, ms", "delay, 95 %, ms",
)  # fmt: skip
CIRCLE = """(() => {
  const { view } = naibuLive;
  let before = performance.now();
  const led = () => {
    if (!window.circling) return;
    const now = performance.now();
    naibuLive.command("move", { at: [30 * Math.cos(now / 500), 30 * Math.sin(now / 500), 60] });
    view.turn((now - before) / 2000, 0);
    before = now;
    requestAnimationFrame(led);
  };
  window.circling = true;
  requestAnimationFrame(led);
})()"""
COUNTED = """(async () => {
  const frames = () => naibuLive.view.renderer.info.render.frame;
  const [began, first] = [performance.now(), frames()];
  await new Promise((done) => setTimeout(done, %d));
  return 1000 * (frames() - first) / (performance.now() - began);
})()"""
DELAY = """new Promise((done) => {
  const { view } = naibuLive;
  const height = 60 + 10 * Math.random();
  const began = performance.now();
  view.setFrame = (frame) => {
    delete view.setFrame;
    const was = view.setFrame;
    was.call(view, frame);
    if (Math.abs(frame.centre[2] - height) < 1e-3) requestAnimationFrame(() => done(performance.now() - began));
    else view.setFrame = again;
  };
  const again = view.setFrame;
  naibuLive.command("move", { at: [0, 0, height] });
})"""
FRAMES = "naibuLive.view.renderer.info.render.frame"
DRAWN = "[new Set(naibuLive.view.skin.geometry.index.array).size, naibuLive.view.canvas.width / naibuLive.view.canvas.clientWidth]"
RENDERER = """(() => {
  const gl = naibuLive.view.renderer.getContext();
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
})()"""
SETTLED_S = 3.0  # for shaders to be compiled, and the picture to find how fine it may be


def sphere(vertices: int) -> tuple[FloatArray, IntArray]:
    """Points and triangles of a closed sphere of about as many vertices, by meridians and parallels, seen from outside."""
    rings = max(8, round(np.sqrt(vertices / 2.0)))
    round_ = 2 * rings
    theta, phi = np.meshgrid(np.arange(1, rings + 1) * np.pi / (rings + 1), np.arange(round_) * np.pi / rings, indexing="ij")
    points = RADIUS * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=2).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings - 1), np.arange(round_), indexing="ij"))
    a, b = round_ * i + j, round_ * i + (j + 1) % round_
    north, south = len(points), len(points) + 1
    first, last = np.arange(round_), (rings - 1) * round_ + np.arange(round_)
    caps = [
        np.stack([np.full(round_, north), first, np.roll(first, -1)], axis=1),
        np.stack([np.full(round_, south), np.roll(last, -1), last], axis=1),
    ]
    sides = [np.stack([a, a + round_, b], axis=1), np.stack([b, a + round_, b + round_], axis=1)]
    return np.vstack([points, [[0.0, 0.0, RADIUS], [0.0, 0.0, -RADIUS]]]), np.concatenate([*sides, *caps])


@dataclass(slots=True)
class Breathing:
    """A source of frames that come 60 times a second."""

    scene: LiveScene
    began: float = field(default_factory=time.monotonic)
    centre: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 60.0]))

    @property
    def number(self) -> int:
        return int(60.0 * (time.monotonic() - self.began))

    def frame(self) -> LiveFrame:
        number = self.number
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


def processor_s(roots: set[int]) -> float:
    """Processor time of these processes and all that they started, s."""
    spent, parent = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            numbers = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        number = int(stat.parent.name)
        parent[number], spent[number] = int(numbers[1]), (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")
    own = set(roots)
    while more := {number for number, by in parent.items() if by in own} - own:
        own |= more
    return sum(spent.get(number, 0.0) for number in own)


def children() -> set[int]:
    """Processes that this one has started."""
    found = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return {int(number) for number in found}


def measured(vertices: int, seconds: float, moves: int) -> tuple[tuple[int, int, float, float, float, float, int, int], str]:
    """A row of the table, and what draws."""
    points, faces = sphere(vertices)
    ball = RigidShape("sphere", "sphere", np.array([8.0, 0.0, 0.0]), np.eye(3))
    scene = LiveScene("Breathing", [], points, faces, np.zeros((0, 4), np.int64), [ball], [], np.zeros((0, 3)), "strain, %", 1.0 / 60.0)
    live = LiveServer(Breathing(scene), "token")
    bound = uvicorn.Config(live.app(0), host="127.0.0.1", port=0, log_level="critical").bind_socket()
    port = bound.getsockname()[1]
    server = web_server(live.app(port), "critical")
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
    thread.start()
    try:
        with opened_browser() as page:
            page.open(f"http://127.0.0.1:{port}/?token=token")
            page.wait("document.querySelector('.stage[data-ready]') !== null", 60)
            time.sleep(SETTLED_S)
            rate = page.value(COUNTED % int(1e3 * seconds))
            page.value(CIRCLE)
            began, spent = page.value(FRAMES), processor_s(children())
            circling = page.value(COUNTED % int(1e3 * seconds))
            each = 1e3 * (processor_s(children()) - spent) / (page.value(FRAMES) - began)
            page.value("window.circling = false")
            delays = np.array([page.value(DELAY) for _ in range(moves)])
            drawn, pixels = page.value(DRAWN)
            renderer = page.value(RENDERER)
    finally:
        server.should_exit = True
        thread.join(timeout=10)
    median, late = (round(float(np.quantile(delays, q))) for q in (0.5, 0.95))
    return (len(points), drawn, round(pixels, 2), round(rate, 1), round(circling, 1), round(each, 1), median, late), renderer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vertices", type=int, nargs="+", default=[5_000, 50_000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--moves", type=int, default=60)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    rows, renderer = [], ""
    for vertices in given.vertices:
        row, renderer = measured(vertices, given.seconds, given.moves)
        rows.append(row)
        print("  ".join(f"{name} {value}" for name, value in zip(COLUMNS, rows[-1], strict=True)), flush=True)
    print(f"Chromium {' '.join(OPTIONS)}: {renderer}")
    if given.record:
        write_record("live_page", [ResultTable("live_page", COLUMNS, tuple(rows))])


if __name__ == "__main__":
    main()
