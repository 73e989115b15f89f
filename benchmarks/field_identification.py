"""Moduli from displacement fields with default settings, beside their goals: ``python benchmarks/field_identification.py``.

    python benchmarks/field_identification.py elements regions unseen      # the cube of chapter 3 of Hirai et al. (2008); some ten minutes
    python benchmarks/field_identification.py inclusion                    # 24 000 unknown tetrahedra, two minutes
    python benchmarks/field_identification.py large                        # 100 000 unknown tetrahedra
    python benchmarks/field_identification.py coverage --repetitions 30    # errors and intervals, data of other code; five minutes
    python benchmarks/field_identification.py tetrahedra --repetitions 30  # the same on tetrahedra
    python benchmarks/field_identification.py surface --repetitions 30     # as `coverage`, forces on the whole surface unknown
    python benchmarks/field_identification.py --seeds 5 --repetitions 20   # shorter

Noise is normal, independent at every point, and given as a fraction of the largest displacement of its load case. `elements`, `regions` and
`unseen` measure the nodes of the mesh that made the data and use its elements as given, as the report does: they show what noise does, and
nothing of the errors of elements. `inclusion` and `large` measure a grid of points in a body that was solved on a finer mesh; `coverage`,
`tetrahedra` and `surface`, random points in bodies that were solved by other code. Every row ends with the goal and whether it was met.
`coverage --record` writes ``results/field_identification.json``, `surface --record` ``results/field_identification_surface.json``.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from records import ResultTable, write_record

from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.core.progress import ProgressReport
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.regularization import cell_volumes
from naibu.identification.from_fields.uncertainty import cramer_rao_bound
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes
from naibu.reproduction.chapter3.bodies import LAYERS, PushedBody, cube
from naibu.validation.specimens.quadratic_body import SHAPES, QuadraticBody

Array = NDArray[np.float64]
_TOP = np.stack([np.tile(np.linspace(0.0, 40.0, 5), 5), np.repeat(np.linspace(0.0, 40.0, 5), 5)], axis=1)
TILT = np.column_stack([np.zeros((25, 2)), -_TOP[:, 0] / 4.0])  # one edge of the top 10 mm down, the other stays
PUSHES = ((0.0, 0.0, -10.0), (7.0, 0.0, -7.0), (0.0, 7.0, -7.0), TILT)
UNSEEN = (4.0, 4.0, -8.0)
TRUTH = np.array(list(LAYERS.values()))  # Young's modulus, kPa, and Poisson's ratio of both layers


def noisy(body: PushedBody, states: Sequence[Array], noise: float, seed: int) -> list[FieldLoadCase]:
    """Load cases measured at the nodes; without noise they are treated as exact."""
    rng = np.random.default_rng(seed)
    out = []
    for k, u in enumerate(states):
        sd = noise * float(np.linalg.norm(u, axis=1).max())
        field = DisplacementField.from_arrays(body.mesh.points, u + sd * rng.standard_normal(u.shape), sd_mm=sd)
        out.append(FieldLoadCase.of(f"push {k + 1}", field, body.mesh, loaded=body.constrained))
    return out


def layered(trials: int, law: str = "linear") -> tuple[PushedBody, list[Array]]:
    """The cube of two unknown layers, and its exact states."""
    body = cube(LAYERS, pushes=PUSHES[:trials], law=law)  # type: ignore[arg-type]
    return body, [body.displacement(p) for p in body.pushes]


def element_errors(body: PushedBody, zones: Zones, found: FieldEstimate) -> tuple[float, float]:
    """Median over the unknown elements of the relative error of E and of the error of Poisson's ratio."""
    unknown = zones.of_cell >= 0
    lame, shear = (values[unknown] for values in found.lame_of_cells())
    young, poisson = young_and_poisson(logarithms(lame, shear))
    true_young, true_poisson = TRUTH[body.mesh.regions[unknown]].T
    return float(np.median(np.abs(young / true_young - 1.0))), float(np.median(np.abs(poisson - true_poisson)))


def row(text: str, met: bool | None) -> None:
    """Print a row and whether its goal was met."""
    print(text + ("" if met is None else "   met" if met else "   NOT met"), flush=True)


def elements(seeds: int, repetitions: int) -> None:
    """A pair of moduli for each of the 192 lower elements, without knowledge of the layers."""
    print("\n(a) a pair of moduli an element, layers unknown; medians over elements, then over seeds")
    print("trials  noise     E, %        nu         told the layers     under TV: E, %    regions   goal")
    goals = {(1, 0.0): (1e-6, np.inf), (1, 1e-3): (3e-3, 5e-4), (1, 1e-2): (3e-2, 5e-3), (4, 1e-3): (3e-3, 5e-4), (4, 1e-2): (3e-2, 5e-3)}
    for (trials, noise), (of_young, of_poisson) in goals.items():
        body, states = layered(trials)
        every, told = body.zones(each_cell=True), body.zones()
        errors, references, penalised, regions = [], [], [], []
        for seed in range(seeds if noise else 1):
            measured = noisy(body, states, noise, seed)
            found = identify_field(body.mesh, measured, every, elements="as_given")
            errors.append(element_errors(body, every, found))
            references.append(element_errors(body, told, identify_field(body.mesh, measured, told, elements="as_given")))
            regions.append(found.zones.count)
            assert found.regularized is not None
            penalised.append(float(np.median(np.abs(found.regularized[0] / TRUTH[body.mesh.regions[every.of_cell >= 0], 0] - 1.0))))
        young, poisson = np.median(errors, axis=0)
        reference = np.median(references, axis=0)
        right = sum(n == 2 for n in regions)
        row(
            f"{trials:6d} {100 * noise:5.1f} %  {100 * young:9.3g}  {poisson:9.3g}   {100 * reference[0]:9.3g} {reference[1]:9.3g}   "
            f"{100 * np.median(penalised):9.3g}        {right}/{len(regions)} two   {100 * of_young:g} %, {of_poisson:g}",
            bool(young < of_young and poisson < of_poisson),
        )


def regions(seeds: int, repetitions: int) -> None:
    """Two layers told: root mean square errors beside the Cramer-Rao bound."""
    print(f"\n(b) moduli of the two layers, root mean square of {repetitions} draws over the Cramer-Rao bound: E 1, E 2, nu 1, nu 2")
    for law in ("linear", "neo_hookean"):
        for trials in (1, 4):
            body, states = layered(trials, law)
            zones = body.zones()
            lame, shear = np.array([lame_parameters(*v) for v in TRUTH]).T
            for noise in (1e-3, 1e-2):
                drawn = []
                for seed in range(repetitions):
                    found = identify_field(body.mesh, noisy(body, states, noise, seed), zones, law=law, elements="as_given")  # type: ignore[arg-type]
                    drawn.append([*np.log(found.young_modulus / TRUTH[:, 0]), *(found.poisson_ratio - TRUTH[:, 1])])
                bound = cramer_rao_bound(body.mesh, noisy(body, states, noise, 0), zones, lame, shear, states, law=law, elements="as_given")  # type: ignore[arg-type]
                of_young, of_poisson = bound.of_young_and_poisson(logarithms(lame, shear))
                rms, least = np.sqrt(np.mean(np.square(drawn), axis=0)), np.concatenate([of_young, of_poisson])
                ratios = rms / least
                row(
                    f"{law:12s} {trials} trials, noise {100 * noise:4.1f} %:  {np.array2string(ratios, precision=2)}   "
                    f"bound E {np.array2string(100 * of_young, precision=3)} %, nu {np.array2string(of_poisson, precision=5)}   goal 1.2",
                    bool((ratios <= 1.2).all()),
                )


def unseen(seeds: int, repetitions: int) -> None:
    """Simulate a push that was not used with what was identified."""
    print(
        "\n(c) a push that was not used, simulated with what was identified: largest distance of a node, share of the largest displacement"
    )
    for law in ("linear", "neo_hookean"):
        for each_cell in (False, True):
            for trials in (1, 4):
                body, states = layered(trials, law)
                zones, true = body.zones(each_cell=each_cell), body.displacement(UNSEEN)
                for noise, goal in ((1e-3, 5e-4), (1e-2, 5e-3)):
                    worst = []
                    for seed in range(seeds if each_cell else 2 * seeds):
                        found = identify_field(body.mesh, noisy(body, states, noise, seed), zones, law=law, elements="as_given")  # type: ignore[arg-type]
                        distance = np.linalg.norm(body.displacement(UNSEEN, found.lame_of_cells()) - true, axis=1)
                        worst.append(distance.max() / np.linalg.norm(true, axis=1).max())
                    row(
                        f"{law:12s} {'an element' if each_cell else 'a layer   '} {trials} trials, noise {100 * noise:4.1f} %:  median "
                        f"{100 * np.median(worst):7.4f} %, worst of {len(worst)} {100 * max(worst):7.4f} %   goal {100 * goal:g} %",
                        bool(np.median(worst) <= goal),
                    )


def ball(mesh: Mesh, radius: float, transition: float) -> Array:
    """Stiffness of every cell over that of its surroundings: a ball four times as stiff off the middle, with a smooth edge."""
    distance = np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - [3.0, -2.0, 20.0], axis=1)
    inside = 0.5 * (1.0 - np.tanh((distance - radius) / transition))
    return np.asarray(np.where(mesh.regions == 0, 4.0**inside, 1.0))


def pressed_ball(
    cells: int, fine: int, *, radius: float = 11.0, transition: float = 3.0, noise: float = 0.005, seed: int = 0
) -> tuple[Mesh, list[FieldLoadCase], Zones, Array]:
    """Three pushes of a cube of 40 mm (10 kPa, 0.4) with a ball in it under a known pad, measured every 2 mm, solved on a finer mesh."""
    rng = np.random.default_rng(seed)
    layers = [("body", 40.0), ("pad", 10.0)]
    truth, mesh = (box((40.0, 40.0, 50.0), (n, n, n + n // 4), layers=layers, cell_type="tetra") for n in (fine, cells))
    lame, shear = (modulus * ball(truth, radius, transition) for modulus in lame_parameters(10.0, 0.4))
    sides, heights = np.arange(-19.0, 20.0, 2.0), np.arange(1.0, 50.0, 2.0)
    points = np.stack(np.meshgrid(sides, sides, heights, indexing="ij"), axis=-1).reshape(-1, 3)
    where, body, trials = interpolation_operator(truth, points), LinearBody.of(truth), []
    floor, top = (np.flatnonzero(np.abs(truth.points[:, 2] - z) < 1e-9) for z in (0.0, 50.0))
    loaded = (mesh.points[:, 2] < 1e-9) | (mesh.points[:, 2] > 50.0 - 1e-9)
    for k, push in enumerate(((0.0, 0.0, -4.0), (4.0, 0.0, -1.0), (0.0, 4.0, -1.0))):
        u = body.solve(lame, shear, PrescribedDisplacement.none(truth.n_points).and_also(floor, (0, 0, 0)).and_also(top, push))
        sd = noise * float(np.linalg.norm(u, axis=1).max())
        vectors = where @ u + sd * rng.standard_normal(points.shape)
        trials.append(FieldLoadCase.of(f"push {k + 1}", DisplacementField.from_arrays(points, vectors, sd_mm=sd), mesh, loaded=loaded))
    zones = Zones.of(mesh, known={"pad": (10.0, 0.4)}, each_cell=True)
    return mesh, trials, zones, ball(mesh, radius, transition)[zones.of_cell >= 0]


def found_ball(mesh: Mesh, zones: Zones, found: FieldEstimate, truth: Array) -> tuple[float, float, float]:
    """Dice's coefficient at half of the contrast, and mean modulus over the true one inside the ball, and outside."""
    unknown = zones.of_cell >= 0
    lame, shear = (values[unknown] for values in found.lame_of_cells())
    ratio = young_and_poisson(logarithms(lame, shear))[0] / 10.0
    inside, true, volume = ratio > 2.0, truth > 2.0, cell_volumes(mesh)[unknown]

    def mean(of: NDArray[np.bool_]) -> float:
        return float(np.exp(np.average(np.log(ratio[of] / truth[of]), weights=volume[of])))

    dice = 2.0 * volume[inside & true].sum() / (volume[inside].sum() + volume[true].sum())
    return float(dice), mean(true), mean(truth < 1.1)


def timed_ball(cells: int, fine: int, goal_s: float, **options: float) -> None:
    """Identify every element of the cube with the ball and print what came out."""
    mesh, trials, zones, truth = pressed_ball(cells, fine, **options)  # type: ignore[arg-type]
    print(
        f"{zones.count} unknown tetrahedra of {mesh.n_cells}, {3 * mesh.n_points} unknown displacements, {len(trials)} trials", flush=True
    )
    start, busy = time.perf_counter(), time.process_time()

    def shown(report: ProgressReport) -> None:
        print(f"    {time.perf_counter() - start:7.1f} s  {report.stage}", flush=True)

    found = identify_field(mesh, trials, zones, progress=shown)
    seconds, of_processors = time.perf_counter() - start, time.process_time() - busy
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform != "darwin" else 2**30)
    dice, modulus, outside = found_ball(mesh, zones, found, truth)
    for line in found.identifiability:
        print(f"    {line}")
    row(
        f"Dice {dice:.3f} (goal 0.9), modulus in the ball {100 * (modulus - 1):+.1f} % (goal 5), outside {100 * (outside - 1):+.1f} %, "
        f"{seconds:.0f} s ({of_processors:.0f} s of processors; goal {goal_s:g} s), at most {memory:.2f} GB",
        bool(dice >= 0.9 and abs(modulus - 1.0) <= 0.05 and seconds <= goal_s),
    )


def inclusion(seeds: int, repetitions: int) -> None:
    """24 000 unknown tetrahedra; the same with a sharp edge, which no goal was set for."""
    print("\n(d) a ball four times as stiff, noise 0.5 %, solved on a mesh of 28^3 cells, identified on one of 16^3")
    timed_ball(16, 28, 120.0)
    print("with a sharp edge (no goal was set)")
    timed_ball(16, 28, 120.0, radius=10.0, transition=0.01)


def large(seeds: int, repetitions: int) -> None:
    """100 000 unknown tetrahedra."""
    print("\n(e) as (d) with 26^3 cells, solved on 36^3")
    timed_ball(26, 36, np.inf)


def coverage(seeds: int, repetitions: int) -> ResultTable:
    """Errors and intervals on three bodies of quadratic hexahedra with other code, 400 points, noise 1 %, one push; naibu on hexahedra."""
    return _coverage("coverage", (("hexahedron", 10, repetitions),))


def tetrahedra(seeds: int, repetitions: int) -> ResultTable:
    """The same on tetrahedra, in a tenth of the draws on the finer mesh."""
    return _coverage("tetrahedra", (("tetra", 6, repetitions), ("tetra", 10, max(1, repetitions // 10))))


def surface(seeds: int, repetitions: int) -> ResultTable:
    """The same on hexahedra with the motion of the whole surface sought, nearly as many components as the measurements have."""
    return _coverage("surface", (("hexahedron", 6, repetitions),), whole_surface=True)


def _coverage(table: str, meshes: tuple[tuple[str, int, int], ...], *, whole_surface: bool = False) -> ResultTable:
    """Print and return the table of meshes: kind of cells, cells a side, draws."""
    print(f"\n(f) bodies solved by other code (27-node hexahedra), 400 points, noise 1 %; {meshes[0][2]} draws of points and noise")
    print("cells  a side  body      mean error   RMS error   stated SD   95 % intervals that hold E   nu         seconds each")
    rows = [covered(name, *mesh, whole_surface=whole_surface) for mesh in meshes for name in SHAPES]
    columns = (
        "body", "cells", "a side", "mean error of E, %", "RMS error, %", "stated SD, %", "95 % intervals that hold E", "and nu"
    )  # fmt: skip
    return ResultTable(table, columns, tuple(rows))


def covered(name: str, cell_type: str, cells: int, draws: int, *, whole_surface: bool) -> tuple[str | float | int, ...]:
    """Print and return a row of `coverage`."""
    body = QuadraticBody(name)
    solved = body.solved((0.0, 0.0, -4.0))
    mesh, loaded = body.model(cells, cell_type)
    loaded[boundary_nodes(mesh)] |= whole_surface
    zones, start, rows = Zones.of(mesh, known={"known": body.known}), time.process_time(), []
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        points, u = solved.at(rng.uniform(0.02, 0.98, (400, 3)))
        sd = 0.01 * float(np.linalg.norm(u, axis=1).max())
        field = DisplacementField.from_arrays(points, u + sd * rng.standard_normal(u.shape), sd_mm=sd)
        found = identify_field(mesh, [FieldLoadCase.of("push", field, mesh, loaded=loaded)], zones)
        young, poisson = found.intervals()
        assert found.uncertainty is not None
        held = [bool(low < truth < high) for (low, high), truth in zip((young[0], poisson[0]), body.unknown, strict=True)]
        rows.append((np.log(found.young_modulus[0] / body.unknown[0]), found.uncertainty.of_young_and_poisson(found.theta)[0][0], *held))
    error, stated, of_young, of_poisson = np.array(rows, dtype=float).T
    bias, rms, inside = error.mean(), np.sqrt(np.mean(error**2)), of_young.mean() >= 0.9
    row(
        f"{cell_type:10s} {cells:3d}  {name:8s} {100 * bias:8.2f} %  {100 * rms:8.2f} %  {100 * stated.mean():8.2f} %   "
        f"{int(of_young.sum()):4d} of {draws} {int(of_poisson.sum()):12d} of {draws} {(time.process_time() - start) / draws:10.1f}",
        bool((whole_surface or abs(bias) <= 0.02) and inside),
    )
    errors = (round(100 * float(value), 2) for value in (bias, rms, stated.mean()))
    return (name, cell_type, cells, *errors, f"{int(of_young.sum())} of {draws}", f"{int(of_poisson.sum())} of {draws}")


STUDIES: dict[str, Callable[[int, int], ResultTable | None]] = {
    "elements": elements, "regions": regions, "unseen": unseen, "inclusion": inclusion, "large": large, "coverage": coverage,
    "tetrahedra": tetrahedra, "surface": surface,
}  # fmt: skip
RECORDS = {"coverage": "field_identification", "surface": "field_identification_surface"}


def main() -> None:
    """Run the studies that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", help=f"any of {', '.join(STUDIES)}; all by default")
    parser.add_argument("--seeds", type=int, default=20, help="draws of noise in `elements` and `unseen`")
    parser.add_argument("--repetitions", type=int, default=100, help="draws of noise in `regions`")
    parser.add_argument("--record", action="store_true", help="write the tables of `coverage` and `surface`")
    chosen = parser.parse_args()
    if chosen.record and not set(RECORDS) & set(chosen.studies):
        parser.error(f"--record goes with the studies {' and '.join(RECORDS)}")
    for name in chosen.studies or STUDIES:
        table = STUDIES[name](chosen.seeds, chosen.repetitions)
        if chosen.record and table is not None and name in RECORDS:
            write_record(RECORDS[name], [table])


if __name__ == "__main__":
    main()
