"""How long a frame of a live body of finite elements takes: quasi-Newton steps with earlier tangents beside steps of Newton's method.

A plate (or another tool) is led onto the body, into it, held and taken away, the same way with both. Times are processor time of the
thread that steps, so that other programs on the machine change them little; the work of the one that renews the tangents stands beside.
Frames have the budget of `naibu live`: a step that takes longer goes on in the next frame, and "steps" are the sums of such frames.
`static` compares the rest under the tool with the offline solution of `QuasiStaticSession`.

Run: ``OMP_NUM_THREADS=1 python benchmarks/live_bodies.py [--body demo|11|13] [--tool plate] [--speed 24] [--repeatable]
[--static | --cut | --pull | --drag [--lips-friction 0.4] | --rub [--live]]``; a number N is a box of 6 N^3 tetrahedra, nu 0.499.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics import Assembler, DynamicEngine, QuasiStaticEngine, RealTimeEngine, elements, material, spherical_indenter
from naibu.mechanics.finite_strain.lip_assembly import lips_of
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.meshing import box, to_tetra
from naibu.simulation import FiniteElementBody, InteractiveSimulation
from naibu.workflows import tools_for, touchable
from naibu.workflows.interactive.cut_kernels import compile_for_cuts
from naibu.workflows.interactive.live import BUDGET_S, DELAY_S

FRAME_S = 1.0 / 60.0
SHEARED_MM = 6.0
SETTLE, PUSH, HOLD, LEAVE = 30, 40, 40, 20  # frames


@dataclass(frozen=True, slots=True)
class Run:
    """Processor times of all frames and of all steps, ms, and the rest under the tool."""

    ms: FloatArray
    steps_ms: FloatArray
    background_ms: float
    positions: FloatArray
    force: FloatArray
    centre: FloatArray
    failed: int


def body_named(name: str) -> FiniteElementBody:
    """The bundled gels, or a box of tetrahedra held at its floor."""
    if name == "demo":
        body = touchable("demo").body
        assert isinstance(body, FiniteElementBody)
        return body
    mesh = to_tetra(box((60.0, 60.0, 60.0), (int(name),) * 3))
    law = material(young_modulus=70.0, poisson_ratio=0.499)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    return FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9))


def repeatable(body: FiniteElementBody) -> FiniteElementBody:
    """The same body, whose tangents are renewed at fixed steps by the thread that steps."""
    return replace(body, engine=replace(body.engine, background=False))


def clock_of_tangents() -> list[float]:
    """Return a list to whose only entry the processor time, s, of every tangent that is made is added from now on."""
    spent, make = [0.0], RealTimeSession._made

    def made(self: RealTimeSession, *given: object) -> EarlierTangent:
        began = time.thread_time()
        try:
            return make(self, *given)  # type: ignore[arg-type]
        finally:
            spent[0] += time.thread_time() - began

    RealTimeSession._made = made  # type: ignore[method-assign]
    return spent


def newtons(body: FiniteElementBody) -> FiniteElementBody:
    """The same body, stepped by Newton's method."""
    e = body.engine
    plain = DynamicEngine(e.points, e.assembler, e.mass, e.faces, e.step, e.normal_stiffness, e.tangential_stiffness)
    return replace(body, engine=plain)


def touched(body: FiniteElementBody, tool: str, speed: float, apart: list[float] | None = None) -> Run:
    """Lead the tool into the body and away, one frame every 1/60 s where the machine keeps up; less the time that is added to `apart`."""
    apart = [0.0] if apart is None else apart
    simulation = InteractiveSimulation(body, tools_for(body))
    if isinstance(body.engine, RealTimeEngine) and body.engine.background:
        simulation.budget_s = BUDGET_S
    frames, done, failed = [], [], 0

    def advance() -> None:
        nonlocal failed
        began = time.perf_counter()
        while True:
            processor = time.thread_time() - apart[0]
            frame = simulation.advance()
            failed += bool(frame.failed)
            frames.append(1e3 * (time.thread_time() - apart[0] - processor))
            done.append(not frame.under_way)
            if done[-1]:
                break
        time.sleep(max(0.0, FRAME_S - (time.perf_counter() - began)))

    for _ in range(SETTLE):
        advance()
    simulation.take(tool)
    centre = np.array(tools_for(body)[tool].centre)
    centre[2] -= 0.07 * simulation.extent_mm
    simulation.move(centre)
    for _ in range(SETTLE):  # it comes near, as a hand leads it
        advance()
    frames.clear()
    done.clear()
    whole, own = time.process_time(), time.thread_time()
    for _ in range(PUSH):
        centre = centre - np.array([0.0, 0.0, speed * FRAME_S])
        simulation.move(centre)
        advance()
    for _ in range(HOLD):
        advance()
    rest = simulation.last
    for _ in range(LEAVE):
        centre = centre + np.array([0.0, 0.0, 2.0 * speed * FRAME_S])
        simulation.move(centre)
        advance()
    background = 1e3 * (time.process_time() - whole - (time.thread_time() - own)) / len(frames)
    simulation.close()
    steps = np.add.reduceat(frames, np.flatnonzero(np.concatenate([[True], done[:-1]])))
    return Run(np.array(frames), steps, background, rest.positions, rest.force, rest.tool_centre, failed)


def offline(body: FiniteElementBody, tool: str, centre: FloatArray) -> FloatArray:
    """Positions under the tool by the static solver."""
    e, indenter = body.engine, tools_for(body)[tool]
    engine = QuasiStaticEngine(
        e.points, e.assembler, e.faces, normal_stiffness=e.normal_stiffness, tangential_stiffness=e.tangential_stiffness
    )
    weight = e.mass[:, None] * body.gravity
    still = [RigidTransform.of(np.eye(3), (0.0, 0.0, 0.0)) for _ in body.fixtures]
    session = engine.session(constrained=[body.supported], external_force=weight, indenters=[*body.fixtures, indenter])
    way = centre - np.array(indenter.centre)
    for part in np.linspace(0.25, 1.0, 16):
        session.step(motions=[*still, RigidTransform.of(np.eye(3), part * way)])
    return session.positions()


def cut(body: FiniteElementBody) -> None:
    """Cut the body half through while it sinks under its weight, and print the frames until the cut has opened, and some more."""
    compile_for_cuts()
    simulation = InteractiveSimulation(replace(body, gravity=np.array([0.0, 0.0, -9810.0])), {})
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    height, middle = 0.6 * low[2] + 0.4 * high[2], 0.5 * (low[1] + high[1])
    frames, opened, simulated = [], -1, time.perf_counter()
    for k in range(1000):
        began, processor = time.perf_counter(), time.thread_time()
        if k == SETTLE:
            simulated = began
            simulation.begin_cut([[[x, low[1] - 5.0, height], [x, middle, height]] for x in (low[0] - 5.0, high[0] + 5.0)])
        if simulation.finish_cut():
            opened, waited = k, began - simulated
        simulation.advance()
        frames.append(1e3 * (time.thread_time() - processor))
        if opened >= 0 and k > opened + HOLD:
            break
        time.sleep(max(0.0, FRAME_S - (time.perf_counter() - began)))
    ms = np.array(frames[SETTLE:])
    print(
        f"cut, {body.mesh.n_cells} to {simulation.body.cells.shape[0]} cells: processor ms a frame: median {np.median(ms):.1f}, "
        f"p99 {np.quantile(ms, 0.99):.1f}, worst {ms.max():.1f}, at the opening {frames[opened]:.1f}; {waited:.1f} s after the command"
    )
    simulation.close()


def dragged(body: FiniteElementBody, lips_friction: float) -> None:
    """Cut a body half through from above, drag a sphere 7 mm across the cut and back, twice, at several places, and print the frames.

    Tangents are renewed at fixed steps, so that only the times differ from run to run.
    """
    radius, (low, high) = 8.0, (body.points.min(axis=0), body.points.max(axis=0))
    middle, still = 0.5 * (low + high), replace(body, engine=replace(body.engine, background=False), lips_friction=lips_friction)
    for friction, offset in ((0.3, 0.0), (1.0, 0.0), (0.3, 2.0), (0.2, 1.0)):
        x = middle[0] + offset
        at = np.array([middle[0] - 3.5, middle[1], high[2] + radius + 3.0])
        sphere = spherical_indenter(at, radius, static_friction=friction, kinetic_friction=friction)
        simulation = InteractiveSimulation(still, {"sphere": sphere})
        simulation.cut([[[x, y, high[2] + 5.0], [x, y, middle[2]]] for y in (low[1] - 5.0, high[1] + 5.0)])
        simulation.take("sphere")
        ms, left, failed = [], [], 0
        for way in [(0.0, -9.0), *2 * [(7.0, 0.0), (-7.0, 0.0)], (0.0, 9.0)]:
            for _ in range(9):  # some 50 mm/s
                at = at + np.array([way[0], 0.0, way[1]]) / 9
                simulation.move(at)
                processor = time.thread_time()
                frame = simulation.advance()
                failed += bool(frame.failed)
                left.append(100.0 * frame.unbalanced)
                ms.append(1e3 * (time.thread_time() - processor))
        median, most, high_ms = np.median(ms), max(ms), np.quantile(ms, 0.9)
        print(
            f"friction {friction:g}, {offset:g} mm beside the cut, {len(simulation.body.cells)} cells: processor ms a frame: "
            f"median {median:.1f}, p90 {high_ms:.1f}, worst {most:.1f}; "
            f"out of balance {np.median(left):.1f} %, at most {max(left):.0f} %; failed {failed} of {len(ms)}",
            flush=True,
        )
        simulation.close()


def rubbed(body: FiniteElementBody, live: bool) -> None:
    """Cut a body right through under its weight, with friction of 0.4 between the sides, let it settle, and shear it to and fro by its top.

    Two cuts, one nearly level and one oblique. Tangents are renewed at fixed steps, so that only the times differ from run to run; where it
    is `live`, a thread renews them, and frames have the budget of `naibu live`.
    """
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    middle = 0.5 * (low + high)
    still = replace(body, engine=replace(body.engine, background=live), lips_friction=0.4)
    for rise in (2.0, 12.0):
        simulation = InteractiveSimulation(still, {}, budget_s=BUDGET_S if live else np.inf)
        for _ in range(SETTLE):
            simulation.advance()
        spent = time.process_time()
        ends = ((low[1] - 30.0, middle[2] + rise), (high[1] + 30.0, middle[2] - rise))
        simulation.begin_cut([[[x, y, z] for y, z in ends] for x in (low[0] - 30.0, high[0] + 30.0)])
        simulation.finish_cut(wait=True)
        opened = time.process_time() - spent
        pairs = sum(len(lips.pairs) for lips in lips_of(simulation.body.engine.assembler))
        print(f"cut, {len(simulation.body.cells)} cells, {pairs} pairs: opens after {opened:.1f} s of a processor", flush=True)
        timed(simulation, "settling", [None] * 60)
        top = int(np.argmin(np.linalg.norm(simulation.body.points - [middle[0], middle[1], high[2]], axis=1)))
        simulation.grip(top, 0.4 * simulation.extent_mm)
        at = simulation.last.positions[top]
        ways = SHEARED_MM * np.sin(2.0 * np.pi * np.arange(1, 61) / 60.0)
        timed(simulation, "sheared to and fro", [at + np.array([way, 0.0, 0.0]) for way in ways])
        simulation.close()


def pulled(body: FiniteElementBody) -> None:
    """Pull a point at the top of a body aside, and lift it, as a hand at the live page does, let go, and print the times of the steps.

    The body has come to rest before: its first step makes a tangent, which at the page no hand sees.
    """
    for name, way, steps in (("pulled aside", (25.0, 0.0, 10.0), 15), ("lifted", (0.0, 0.0, 40.0), 20)):
        simulation = InteractiveSimulation(body, tools_for(body), budget_s=BUDGET_S, delay_s=DELAY_S)
        for _ in range(SETTLE):
            simulation.advance()
            time.sleep(0.5 * FRAME_S)  # in which its thread makes the tangent of the body as it lies
        top = int(np.argmax(body.points @ [0.3, 0.3, 1.0]))
        simulation.grip(top, 0.08 * simulation.extent_mm)
        at = simulation.last.positions[top]
        led = [at + part * np.array(way) for part in np.linspace(0.0, 1.0, steps + 1)[1:]]
        seconds, own, left, frames, failed = [], [], [], [], 0
        for place in [*led, *[led[-1]] * 5, *[None] * 20]:
            if place is None:
                simulation.release()
            else:
                simulation.pull(place)
            began, stepped, under_way = time.process_time(), time.thread_time(), True
            while under_way:
                frames.append(time.thread_time())
                frame = simulation.advance()
                frames[-1] = 1e3 * (time.thread_time() - frames[-1])
                failed += bool(frame.failed)
                under_way = frame.under_way
            seconds.append(time.process_time() - began)
            own.append(time.thread_time() - stepped)
            left.append(frame.unbalanced)
        late = np.array(seconds) > 0.3
        print(
            f"{name} and let go, {len(seconds)} steps: {sum(seconds):.1f} s of all threads, {late.sum()} steps above .3 s take "
            f"{np.array(seconds)[late].sum():.1f} s, median {1e3 * np.median(seconds):.0f} ms, worst {max(seconds):.2f} s; "
            f"of the thread that steps {sum(own):.1f} s, median {1e3 * np.median(own):.0f} ms, p90 {1e3 * np.quantile(own, 0.9):.0f}, "
            f"worst {max(own):.2f} s, above 17 ms {np.count_nonzero(np.array(own) > 0.017)}; "
            f"{len(frames)} frames, p90 {np.quantile(frames, 0.9):.0f} ms, worst {max(frames):.0f}; "
            f"out of balance at most {100.0 * max(left):.0f} %, failed {failed}",
            flush=True,
        )
        simulation.close()


def timed(simulation: InteractiveSimulation, name: str, places: Sequence[FloatArray | None]) -> None:
    """Take steps, the gripped nodes led to these places, and print the times of their frames and what was out of balance."""
    ms, left, failed = [], [], 0
    for place in places:
        if place is not None:
            simulation.pull(place)
        under_way = True
        while under_way:
            processor = time.thread_time()
            frame = simulation.advance()
            ms.append(1e3 * (time.thread_time() - processor))
            failed += bool(frame.failed)
            under_way = frame.under_way
        left.append(100.0 * frame.unbalanced)
    loose = np.count_nonzero(np.array(left) > 5.0)
    print(
        f"{name}, {len(left)} steps in {len(ms)} frames: {1e-3 * sum(ms):.1f} s of a processor, median {np.median(ms):.1f} ms, "
        f"p95 {np.quantile(ms, 0.95):.0f}, worst {max(ms):.0f}; "
        f"out of balance {np.median(left):.1f} %, at most {max(left):.0f} %, above 5 % in {loose}; failed {failed}",
        flush=True,
    )


def report(name: str, run: Run) -> None:
    median, high = np.median(run.ms), np.quantile(run.ms, 0.99)
    print(
        f"{name:>22}: processor ms a frame: median {median:6.1f}, p99 {high:6.1f}, worst {run.ms.max():6.1f}; "
        f"a step: p95 {np.quantile(run.steps_ms, 0.95):.1f}, p99 {np.quantile(run.steps_ms, 0.99):.1f}, worst {run.steps_ms.max():.1f}, "
        f"{np.count_nonzero(run.steps_ms > 33.0)} of {len(run.steps_ms)} above 33 ms; other threads "
        f"{run.background_ms:5.1f}; frames above 33 ms {np.count_nonzero(run.ms > 33.0)} of {len(run.ms)}; failed {run.failed}; "
        f"force {1e-3 * run.force[2]:.3f} N"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--body", default="demo")
    parser.add_argument("--tool", default="plate")
    parser.add_argument("--speed", type=float, default=24.0, help="mm/s")
    parser.add_argument("--static", action="store_true")
    parser.add_argument("--cut", action="store_true", help="only time a cut")
    parser.add_argument("--pull", action="store_true", help="only pull a point aside, and lift it, and let go")
    parser.add_argument("--drag", action="store_true", help="only drag a sphere across a cut and back")
    parser.add_argument("--lips-friction", type=float, default=0.0, help="between the sides of the cut that a sphere is dragged across")
    parser.add_argument("--rub", action="store_true", help="only cut through with friction, and shear")
    parser.add_argument("--live", action="store_true", help="rub as `naibu live` steps: in frames, with a thread for the tangents")
    parser.add_argument("--repeatable", action="store_true", help="tangents at fixed steps, whose time is left out")
    given = parser.parse_args()
    body = body_named(given.body)
    print(f"{given.body}: {body.mesh.n_cells} cells, {body.mesh.n_points} nodes; {given.tool}, {given.speed:g} mm/s")
    gc.freeze()  # as `naibu live` does
    if given.cut:
        cut(body)
        return
    if given.pull:
        pulled(body)
        return
    if given.drag:
        dragged(body, given.lips_friction)
        return
    if given.rub:
        rubbed(body, given.live)
        return
    fast = (
        touched(repeatable(body), given.tool, given.speed, clock_of_tangents())
        if given.repeatable
        else touched(body, given.tool, given.speed)
    )
    report("earlier tangents", fast)
    slow = touched(newtons(body), given.tool, given.speed)
    report("Newton", slow)
    moved = np.abs(slow.positions - body.points).max()
    high = np.quantile(slow.ms, 0.99) / np.quantile(fast.ms, 0.99)
    print(f"ratio of medians {np.median(slow.ms) / np.median(fast.ms):.1f}, of p99 {high:.1f}")
    apart = np.abs(fast.positions - slow.positions).max() / moved
    print(f"rest under the tool, greatest difference: {100 * apart:.2f} % of the displacement")
    if given.static:
        static = offline(body, given.tool, fast.centre)
        print(f"and from the offline solution: {100 * np.abs(fast.positions - static).max() / moved:.2f} %")


if __name__ == "__main__":
    main()
