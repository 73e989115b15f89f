"""Adaptive mass-spring meshes: Table I and Figures 6 to 12 of the 2008 report :cite:p:`hirai2008` (chapter 4.2)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.meshing.primitives import box
from naibu.meshing.refinement.marking import EdgeStretch, edge_stretches
from naibu.meshing.surface import boundary_faces
from naibu.reproduction.chapter4 import adaptive_figures
from naibu.reproduction.chapter4.spring_levels import levels_section
from naibu.reproduction.printed_tables import printed_table
from naibu.simulation.adaptive.conditions import Conditions, Selection, face_force, weight
from naibu.simulation.adaptive.lattice import AdaptiveLattice, SpringMaterial
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

SIDE_MM, E_KPA, DENSITY = 100.0, 50.0, 1e-7  # the side is not printed
MATERIAL = SpringMaterial(E_KPA, DENSITY, damping_ratio=0.3)
LOW, HIGH, EDGE = 4, 9, 1e-6  # cubes along a side
NEVER = 1 << 60  # steps between adaptations where the study calls for them itself
STEP_S, INTERVAL, RECORDS = 5e-4, 10, 60  # steps between two records and adaptations; records until release, and after it
FORCES_MN = (6e3, 8e3, 1e4, 1.2e4)
CRITERION = EdgeStretch(1.05, 1.02)
REFINED = 3  # bisections to an eighth of the volume


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A deformed mesh: positions (n, 3), mm, cells (m, 4), boundary faces (f, 3), and the largest edge stretch of the cells behind (f,)."""

    position: FloatArray
    cells: IntArray
    faces: IntArray
    stretch: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """A motion, recorded every `INTERVAL` steps.

    Attributes
    ----------
    times : ndarray, shape (k,)
        s.
    watched : ndarray, shape (k, 3)
        Mean displacement of the watched nodes, mm.
    nodes, tetrahedra : ndarray, shape (k,)
        Sizes of the mesh.
    step_ms, adaptation_ms : ndarray, shape (k,)
        Processor time of a step, and of the adaptation of the mesh as a part of each of the steps before it, ms.
    snapshots : tuple of Snapshot
        At the end of each part of the motion.
    """

    times: FloatArray
    watched: FloatArray
    nodes: IntArray
    tetrahedra: IntArray
    step_ms: FloatArray
    adaptation_ms: FloatArray
    snapshots: tuple[Snapshot, ...]


def chapter4_adaptive(seed: int = 0, *, records: int = RECORDS, forces: tuple[float, ...] = FORCES_MN) -> Chapter:
    """Reproduce the adaptive mass-spring meshes of the report.

    Parameters
    ----------
    seed : int
        Of the cells that are refined one after the other in the study of stability.
    records : int
        Length of each part of the motions, in `INTERVAL` steps.
    forces : tuple of float
        Forces at the end of the cuboid, mN; the report prints none. The figures are those of the one that comes nearest to its table.
    """
    levels = levels_section(cuboid(2), 2, E_KPA)
    sections = (bending_section(records, forces), stability_section(seed, records), contact_section(records), levels)
    settings: dict[str, Cell] = {
        "seed": seed, "side_mm": SIDE_MM, "young_modulus_kpa": E_KPA, "density_kg_mm3": DENSITY, "step_s": STEP_S,
        "damping_ratio": MATERIAL.damping_ratio, "refine_above": CRITERION.refine_above, "coarsen_below": CRITERION.coarsen_below,
    }  # fmt: skip
    return Chapter("ch4-adaptive", "Chapter 4.2: adaptive mass-spring meshes", sections, settings)


def cuboid(n: int, *, mirrored: bool = True) -> Mesh:
    """Return the cuboid of n cubes along a side, six tetrahedra each.

    Neighbouring cubes are mirror images of each other, as bisection makes them, or else all have parallel diagonals.
    """
    if not mirrored:
        return box((SIDE_MM,) * 3, (n, n, n), cell_type="tetra", centred=False)
    grid = np.stack(np.meshgrid(*(np.arange(n + 1),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cubes = grid[(grid < n).all(axis=1)]
    even, odd = cubes + cubes % 2, cubes + 1 - cubes % 2
    cells = []
    for order in permutations(range(3)):
        corners = [even.copy()]
        for axis in order:
            corners.append(corners[-1].copy())
            corners[-1][:, axis] = odd[:, axis]
        cells.append(np.stack([c @ ((n + 1) ** 2, n + 1, 1) for c in corners], axis=1))
    points, found = SIDE_MM / n * grid, np.concatenate(cells)
    inverted = np.linalg.det(points[found[:, 1:]] - points[found[:, :1]]) < 0.0
    found[inverted, 2:] = found[inverted, :1:-1]
    return Mesh.from_arrays(points, found, "tetra")


def at_start(points: FloatArray) -> BoolArray:
    """Select the end that is fixed."""
    return np.asarray(points[:, 0] < EDGE)


def at_end(points: FloatArray) -> BoolArray:
    """Select the other end."""
    return np.asarray(points[:, 0] > SIDE_MM - EDGE)


def corners_of_end(points: FloatArray) -> BoolArray:
    """Select the four corners of the free end, which all meshes have."""
    inner = (points[:, 1:] > EDGE) & (points[:, 1:] < SIDE_MM - EDGE)
    return np.asarray(at_end(points) & ~inner.any(axis=1))


def lattice_of(n: int, conditions: Conditions, criterion: EdgeStretch | None, *, level: int = 0, mirrored: bool = True) -> AdaptiveLattice:
    """Return the lattice of the cuboid of n cubes along a side, at rest, all of its cells bisected to a level."""
    mesh, bisections = cuboid(n, mirrored=mirrored), max(level, 1)
    lattice = AdaptiveLattice.of(mesh, MATERIAL, conditions, criterion, bisections=bisections, interval=NEVER, step=STEP_S)
    if level:
        lattice.change(lattice.mesh.leaf.cells)
    lattice.mesh.bisections = REFINED
    return lattice


def recorded(lattice: AdaptiveLattice, watched: Selection, parts: Sequence[tuple[Conditions, int]], velocity: ArrayLike = 0.0) -> Record:
    """Record a motion in parts, each of conditions and a number of records; `watched` selects nodes, `velocity` is that of moved ones."""
    rows: list[tuple[float, FloatArray, int, int, float, float]] = []
    snapshots = []
    for conditions, count in parts:
        lattice.constrain(conditions)
        moving = velocity if conditions.moved else 0.0
        for _ in range(count):
            began = time.process_time()
            lattice.step(moving, steps=INTERVAL)
            stepped = time.process_time()
            lattice.adapt()
            spent = (1e3 * (stepped - began) / INTERVAL, 1e3 * (time.process_time() - stepped) / INTERVAL)
            mesh, u = lattice.mesh.leaf.mesh, lattice.positions() - lattice.lattice.points
            rows.append(((len(rows) + 1) * INTERVAL * STEP_S, u[watched(mesh.points)].mean(axis=0), mesh.n_points, mesh.n_cells, *spent))
        snapshots.append(_snapshot(lattice))
    times, u, nodes, tetrahedra, step_ms, adaptation_ms = (np.array(values) for values in zip(*rows, strict=True))
    return Record(times, u, nodes, tetrahedra, step_ms, adaptation_ms, tuple(snapshots))


def _snapshot(lattice: AdaptiveLattice) -> Snapshot:
    mesh, position = lattice.mesh.leaf.mesh, lattice.positions()
    boundary = boundary_faces(mesh)
    stretch = edge_stretches(mesh.points, mesh.cells, position - mesh.points, False)
    return Snapshot(position, mesh.cells, boundary.faces, stretch[boundary.cells])


def bent(n: int, criterion: EdgeStretch | None, force_mn: float, records: int) -> Record:
    """Record the cuboid that a constant force at its end bends, and that is then released."""
    loaded, released = loaded_end(force_mn), Conditions(at_start)
    return recorded(lattice_of(n, loaded, criterion), corners_of_end, ((loaded, records), (released, records)))


def loaded_end(force_mn: float) -> Conditions:
    """Return one end fixed and a force across the other."""
    return Conditions(at_start, loads=(face_force(at_end, (0.0, 0.0, -force_mn)),))


def bending_section(records: int, forces: tuple[float, ...]) -> Section:
    """Return Table I, the forces that it depends on, the motion and the cost of a step."""
    bent(LOW, CRITERION, forces[-1], 2)  # compiles what the cost of an iteration is not to hold
    printed = {str(r[0]): (int(r[1]), int(r[2])) for r in printed_table("4-adaptive")[1]}
    adaptive = {force: bent(LOW, CRITERION, force, records) for force in forces}
    release = records - 1
    nearest = min(forces, key=lambda force: abs(int(adaptive[force].nodes[release]) - printed["adaptive"][0]))
    found = {"low": bent(LOW, None, nearest, records), "high": bent(HIGH, None, nearest, records), "adaptive": adaptive[nearest]}
    counts = Table(
        "Table I",
        ("model", "paper, nodes", "ours, nodes", "paper, tetrahedra", "ours, tetrahedra", "ours at the end, nodes"),
        tuple(
            (name, printed[name][0], int(r.nodes[release]), printed[name][1], int(r.tetrahedra[release]), int(r.nodes[-1]))
            for name, r in found.items()
        ),
        caption=f"Sizes of the meshes when the cuboid is released, under {nearest / 1e3:g} N.",
        note="The report prints neither the force nor the size of the cuboid; of the forces below, this one comes nearest to its nodes.",
    )
    by_force = Table(
        "Forces",
        ("force, N", "deflection, mm", "nodes", "tetrahedra", "largest stretch"),
        tuple(
            (f / 1e3, float(-r.watched[release, 2]), int(r.nodes[release]), int(r.tetrahedra[release]), float(r.snapshots[0].stretch.max()))
            for f, r in adaptive.items()
        ),
        caption="The adaptive model at release, by the force at its end.",
    )
    text = (
        "A cuboid of 4 x 4 x 4 cubes of six tetrahedra (low), of 9 x 9 x 9 (high), and of 4 x 4 x 4 whose tetrahedra are bisected to an "
        f"eighth of their volume where an edge is stretched by more than {CRITERION.refine_above:g}, and joined where all are below "
        f"{CRITERION.coarsen_below:g} (adaptive). One end is fixed, a constant force bends the other and is then removed.",
    )
    figures = (
        Figure("Fig. 7, 8", "Shapes at release and at the end; colours: edge stretch.", adaptive_figures.shapes(found), (9.0, 6.0)),
        Figure("Motion", "Deflection of the free end.", adaptive_figures.deflections(found, "deflection, mm"), (7.0, 3.5)),
        Figure("Fig. 9", "Processor time of an iteration, adaptation included.", adaptive_figures.costs(found), (7.0, 3.5)),
    )
    return Section(
        "A cuboid bent by a force and released", text, (counts, by_force, _meshes(nearest, records, found), _costs(found, release)), figures
    )


def _meshes(force_mn: float, records: int, found: dict[str, Record]) -> Table:
    """Return the deflection of other meshes: what the formulas of the springs make of it."""
    conditions, rows = loaded_end(force_mn), []
    meshes = [
        (f"mirrored cubes, all cells of level {level}, type {'I' * (level % 3 + 1)}", LOW, level, True) for level in range(REFINED + 1)
    ]
    meshes += [("mirrored cubes (high)", HIGH, 0, True), ("parallel diagonals", LOW, 0, False), ("parallel diagonals", HIGH, 0, False)]
    for name, n, level, mirrored in meshes:
        r = recorded(lattice_of(n, conditions, None, level=level, mirrored=mirrored), corners_of_end, ((conditions, records),))
        rows.append((name, int(r.nodes[-1]), float(-r.watched[-1, 2])))
    rows.append(("adaptive", int(found["adaptive"].nodes[records - 1]), float(-found["adaptive"].watched[records - 1, 2])))
    note = (
        "All formulas are the report's. They give every mesh springs of the same mean modulus, but in other directions: the stiffness "
        "depends on the type of the tetrahedra and on how the diagonals run, not only on the resolution, and a mixed mesh may be stiffer "
        "than the coarse one that it was made of."
    )
    return Table("Meshes", ("mesh", "nodes", "deflection, mm"), tuple(rows), caption=f"Deflection under {force_mn / 1e3:g} N.", note=note)


def _costs(found: dict[str, Record], release: int) -> Table:
    high = float(np.median(found["high"].step_ms[: release + 1]))
    rows: list[tuple[Cell, ...]] = []
    for name, r in found.items():
        parts = [float(np.mean(ms[part])) for part in (slice(release + 1), slice(release + 1, None)) for ms in (r.step_ms, r.adaptation_ms)]
        rows.append((name, *parts, parts[0] / high if high > 0.0 else None))  # a coarse clock sees no time pass
    columns = (
        "model",
        "under the force: step, ms",
        "and adaptation, ms",
        "released: step, ms",
        "and adaptation, ms",
        "step, of the high resolution",
    )
    note = (
        f"Implicit steps on one thread, on the machine that made this page; the adaptation every {INTERVAL} steps is shared among them. "
        "The report's are Runge-Kutta steps, and only drawn. Steps of so few springs cost less than what prepares a mesh for them: at "
        "this size adaptation saves time only where the mesh seldom changes."
    )
    return Table("Cost", columns, tuple(rows), caption="Mean processor time of an iteration.", note=note)


def stability_section(seed: int, records: int) -> Section:
    """Return the oscillation under gravity between two fixed ends, with fixed and changing resolution."""
    held = Conditions(lambda p: at_start(p) | at_end(p), loads=(weight((0.0, 0.0, -9810.0)),))
    runs = {path: oscillation(path, held, seed, records) for path in ("fixed", "refined gradually", "refined, coarsened, refined")}
    (_, reference), rows = runs["fixed"], []
    sag = max(abs(float(x[2] - p[2])) for p, x in reference.items())
    for path, (record, ends) in runs.items():
        apart = np.abs(record.watched[:, 2] - runs["fixed"][0].watched[:, 2])
        last = max(float(np.abs(ends[p] - x).max()) for p, x in reference.items())
        rows.append((path, int(record.nodes[0]), int(record.nodes[-1]), float(apart.max()) / sag, last / sag))
    columns = ("resolution", "nodes at the start", "nodes at the end", "largest difference of the motion", "difference at rest")
    table = Table("Fig. 12", columns, tuple(rows), caption="Differences from the fixed resolution, as fractions of the sag at rest.")
    text = (
        "The cuboid is fixed at both ends and released under its weight. Its tetrahedra are bisected, some every "
        f"{INTERVAL} steps, until the mesh is that of the fixed resolution. Springs, masses and lengths at rest depend on the mesh only: "
        f"the oscillation differs while the resolution changes, and the stationary state does not (sag {sag:.3g} mm).",
    )
    motions = {path: run[0] for path, run in runs.items()}
    figure = Figure("Fig. 12", "The middle of the lower face.", adaptive_figures.deflections(motions, "deflection, mm"), (7.0, 3.5))
    return Section("Stability of the dynamic change of the resolution", text, (table,), (figure,))


def oscillation(path: str, held: Conditions, seed: int, records: int) -> tuple[Record, dict[tuple[float, ...], FloatArray]]:
    """Record the middle of the lower face on one path of refinement; return also the positions at rest by those of the mesh at rest."""
    lattice, rng = lattice_of(LOW, held, None, level=REFINED if path == "fixed" else 0), np.random.default_rng(seed)
    lattice.tolerance = 1e-7

    def below(points: FloatArray) -> BoolArray:
        return np.asarray(np.linalg.norm(points - [0.5 * SIDE_MM, 0.5 * SIDE_MM, 0.0], axis=1) < EDGE)

    parts: list[Record] = []
    for k in range(records):
        parts.append(recorded(lattice, below, ((held, 1),)))
        left = lattice.mesh.leaf.cells
        left = left[lattice.mesh.forest.levels[left] < REFINED]
        if len(left):
            lattice.change(left if k > records // 2 else rng.choice(left, min(40, len(left)), replace=False))
        if path == "refined, coarsened, refined" and k == records // 4:
            while lattice.change(coarsen=lattice.mesh.leaf.cells):
                pass
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts]) for name in ("watched", "nodes", "tetrahedra", "step_ms", "adaptation_ms")
    }
    record = Record(INTERVAL * STEP_S * np.arange(1.0, records + 1.0), **joined, snapshots=parts[-1].snapshots)
    lattice.time_step = 2e-2  # long implicit steps damp what is left
    lattice.constrain(held)
    lattice.step(steps=400)
    places = np.round(lattice.lattice.points, 6)
    return record, {tuple(p): x for p, x in zip(places.tolist(), lattice.positions(), strict=True)}


def contact_section(records: int) -> Section:
    """Return the cuboid that a point pushes in and leaves again."""

    def top(points: FloatArray) -> BoolArray:
        return np.asarray(np.linalg.norm(points - [0.5 * SIDE_MM, 0.5 * SIDE_MM, SIDE_MM], axis=1) < EDGE)

    def floor(points: FloatArray) -> BoolArray:
        return np.asarray(points[:, 2] < EDGE)

    pushed, left = Conditions(floor, (top,)), Conditions(floor)
    lattice = lattice_of(LOW, pushed, CRITERION)
    speed = -0.15 * SIDE_MM / (records * INTERVAL * STEP_S)
    record = recorded(lattice, top, ((pushed, records), (left, records)), [[0.0, 0.0, 0.0], [0.0, 0.0, speed]])
    rows = tuple(
        (name, float(-record.watched[k, 2]), int(record.nodes[k]), int(record.tetrahedra[k]))
        for name, k in (("deepest", records - 1), ("after", 2 * records - 1))
    )
    table = Table("Fig. 10", ("state", "depth, mm", "nodes", "tetrahedra"), rows, caption="Sizes of the mesh.")
    figure = Figure("Fig. 10", "Cross-section through the point.", adaptive_figures.contact(record, SIDE_MM), (8.0, 4.0))
    text = ("A point pushes the middle of the upper face in by 15 % of the height, and lets it go; the lower face is fixed.",)
    return Section("Contact with a point", text, (table,), (figure,))
