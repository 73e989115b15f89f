"""Moduli from markers in bodies that FElupe compressed: ``python benchmarks/marker_identification.py`` (needs ``pip install felupe``).

A block of two layers, 60 mm high, is compressed by 8 to 12 mm with 20-node hexahedra of another program; 125 markers move with it, and
either scan adds 0.15 mm of noise. `naibu.identify` is given the layers, the stated height and the modulus of the lower layer. Some blocks
are not what is stated of them. Two models then predict markers under 20 mm of compression.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import felupe
import numpy as np
from records import Cell, ResultTable, write_record

import naibu
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.markers import Markers

SIZE_MM, MEETS_MM, LOWER_KPA, UPPER_KPA = 60.0, 30.0, 60.0, 20.0
CELLS, STEPS = 8, 9
NOISE_MM, MARGIN_MM, MARKERS_ALONG = 0.15, 6.0, 5
HIDDEN_AT_MM, HIDDEN_RADIUS_MM = (12.0, 0.0, 42.0), 11.0
BAR_WIDTH_MM = 15.0
DEEP_MM = 20.0


@dataclass(frozen=True)
class Block:
    """A block as it is: how it is held and pressed, and Young's moduli, kPa, at points (k, 3)."""

    press_mm: float = 12.0
    poisson_ratio: float = 0.48
    lower_kpa: float = LOWER_KPA
    meets_mm: float = MEETS_MM
    hidden_kpa: float | None = None
    sliding: bool = False
    bar: bool = False

    def young_modulus(self, points: np.ndarray) -> np.ndarray:
        """Young's moduli, kPa, at `points`, mm."""
        moduli = np.where(points[:, 2] < self.meets_mm, self.lower_kpa, UPPER_KPA)
        if self.hidden_kpa is None:
            return moduli
        return np.where(np.linalg.norm(points - HIDDEN_AT_MM, axis=1) < HIDDEN_RADIUS_MM, self.hidden_kpa, moduli)


CASES = {
    "plates that stick": Block(),
    "plates without friction": Block(sliding=True),
    "bar": Block(press_mm=10.0, bar=True),
    "Poisson's ratio 0.3": Block(poisson_ratio=0.3),
    "lower layer of 300 kPa": Block(press_mm=8.0, lower_kpa=300.0),
    "not stated: layers meet at 37.5 mm": Block(meets_mm=37.5),
    "not stated: a sphere of 400 kPa": Block(hidden_kpa=400.0),
    "not stated: a sphere of 60 kPa": Block(hidden_kpa=60.0),
}


PREDICTED = ("plates that stick", "plates without friction")
COLUMNS = ("block", "E of the upper layer (20), kPa", "95 %", "95 % if the law is exact", "Poisson's ratio: 95 %", "RMS, mm", "verdict")
PREDICTED_COLUMNS = ("block", "RMS, mm", "stated SD of a coordinate (median), mm", "within 95 %, %")


def displaced(block: Block, markers: np.ndarray) -> np.ndarray:
    """Positions (k, 3), mm, of `markers` in the compressed block."""
    half, nodes = SIZE_MM / 2.0, CELLS + 1
    cubes = felupe.Cube(a=(-half, -half, 0.0), b=(half, half, SIZE_MM), n=(nodes, nodes, nodes))
    mesh = cubes.add_midpoints_edges(cell_type="hexahedron20")
    field = felupe.FieldContainer([felupe.Field(felupe.RegionQuadraticHexahedron(mesh), dim=3)])
    young = block.young_modulus(mesh.points[mesh.cells].mean(axis=1))[None, :]
    law = felupe.NeoHooke(mu=young / (2.0 * (1.0 + block.poisson_ratio)), bulk=young / (3.0 * (1.0 - 2.0 * block.poisson_ratio)))
    law.chunksize = None  # moduli by cell are not cut into chunks with the cells
    boundaries = _held(block, field[0], mesh.points)
    ramp = {boundaries["pressed"]: -block.press_mm * np.arange(1, STEPS + 1) / STEPS}
    felupe.Job(steps=[felupe.Step(items=[felupe.SolidBody(law, field)], ramp=ramp, boundaries=boundaries)]).evaluate(verbose=0)
    return markers + _interpolated(mesh, field[0].values, markers)


def _held(block: Block, field: felupe.Field, points: np.ndarray) -> dict[str, felupe.Boundary]:
    """Base and pressed part of the top; where they slide, two points of the base keep the block from drifting and turning."""
    base, pressed = np.isclose(points[:, 2], 0.0), np.isclose(points[:, 2], SIZE_MM)
    if block.bar:
        pressed &= np.abs(points[:, 0]) <= BAR_WIDTH_MM / 2.0 + 1e-9
    centre, edge = (np.all(np.isclose(points, p), axis=1) for p in ([0.0, 0.0, 0.0], [SIZE_MM / 2.0, 0.0, 0.0]))
    along_xy, along_y, along_z = (0, 0, 1), (1, 0, 1), (1, 1, 0)  # what is not held is skipped
    held = {"base": (base, along_z), "pressed": (pressed, along_z)}
    held |= {"centre": (centre, along_xy), "edge": (edge, along_y)} if block.sliding else {"sticks": (base | pressed, along_xy)}
    return {name: felupe.Boundary(field, mask=nodes, skip=skip) for name, (nodes, skip) in held.items()}


def _interpolated(mesh: felupe.Mesh, values: np.ndarray, markers: np.ndarray) -> np.ndarray:
    """Nodal `values` at `markers` by the shape functions of their elements, which are axis-parallel cubes."""
    low, high = mesh.points[mesh.cells].min(axis=1), mesh.points[mesh.cells].max(axis=1)
    element = felupe.QuadraticHexahedron()
    out = np.empty_like(markers)
    for i, marker in enumerate(markers):
        cell = int(np.flatnonzero(np.all((marker >= low - 1e-9) & (marker <= high + 1e-9), axis=1))[0])
        local = 2.0 * (marker - low[cell]) / (high[cell] - low[cell]) - 1.0
        out[i] = element.function(local) @ values[mesh.cells[cell]]
    return out


def experiment(name: str, block: Block, folder: Path, rng: np.random.Generator) -> Path:
    """Write the experiment of a block, as it is stated, to `folder`."""
    half = SIZE_MM / 2.0 - MARGIN_MM
    along = np.linspace(-half, half, MARKERS_ALONG)
    points = np.array(list(product(along, along, along + SIZE_MM / 2.0))) + rng.normal(0.0, 1.0, (MARKERS_ALONG**3, 3))
    pressed = displaced(block, points)
    ids = np.arange(1, len(points) + 1)
    loading = Loading("bar", bar_width_mm=BAR_WIDTH_MM, bar_axis="y") if block.bar else Loading("plate")
    return naibu.io.write_experiment_folder(
        folder,
        Markers.from_arrays(ids, points + rng.normal(0.0, NOISE_MM, points.shape)),
        {"pressed": Markers.from_arrays(ids, pressed + rng.normal(0.0, NOISE_MM, points.shape))},
        title=name,
        shape=Shape("box", (SIZE_MM, SIZE_MM, SIZE_MM)),
        loading=loading,
        layers=[Layer("lower", 0.0, MEETS_MM), Layer("upper", MEETS_MM, SIZE_MM)],
        stated_mm={"pressed": SIZE_MM - block.press_mm},
        xy_sd_mm=NOISE_MM,
        z_sd_mm=NOISE_MM,
    )


def identified(name: str, block: Block, folder: Path, rng: np.random.Generator) -> tuple[tuple[Cell, ...], naibu.Identification]:
    """Identify one block; return its row of the table and the result."""
    found = naibu.identify(experiment(name, block, folder, rng), known=[f"lower={block.lower_kpa:g} kPa"])
    (low, high), (exact_low, exact_high) = (found.model.interval("upper: young_modulus", law_exact=exact) for exact in (False, True))
    values = {p.name: p.value for p in found.model.parameters}
    nu_low, nu_high = found.model.interval("upper: poisson_ratio")
    (fit,) = found.calibration.match.fits
    return (
        name,
        f"{values['upper: young_modulus']:.1f}",
        f"{low:.1f} to {high:.1f}",
        f"{exact_low:.1f} to {exact_high:.1f}",
        f"{block.poisson_ratio:g}: {nu_low:.3f} to {nu_high:.3f}",
        f"{np.sqrt((fit.residual**2).sum(axis=1).mean()):.2f}",
        verdict_in_short(found),
    ), found


def verdict_in_short(found: naibu.Identification) -> str:
    """The explanation, and where something speaks against it, the first words of why."""
    told = found.verdict.explanation.value
    noted = [n for n in found.verdict.notes if "off by" in n]
    reasons = "; ".join((*found.verdict.reasons, *noted)).replace("/pressed", "")
    return f"{told}: {reasons}" if reasons else told


def predicted(name: str, found: naibu.Identification, folder: Path, rng: np.random.Generator) -> tuple[Cell, ...]:
    """Predict the block of a model under a deeper compression; return its row of the table."""
    deeper = replace(CASES[name], press_mm=DEEP_MM)
    run = naibu.predict(found.model, experiment(name, deeper, folder, rng))
    within = np.abs(run.residual) < 1.96 * np.hypot(run.sd_mm, NOISE_MM)
    return name, f"{np.sqrt((run.residual**2).sum(axis=1).mean()):.2f}", f"{np.median(run.sd_mm):.2f}", f"{100.0 * within.mean():.0f}"


def main() -> None:
    """Print what is found, and what is predicted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", action="store_true", help="write results/marker_identification.json")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    rows, predictions = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, block) in enumerate(CASES.items()):
            row, found = identified(name, block, Path(folder) / str(number) / "block", rng)
            rows.append(row)
            print(" | ".join(map(str, row)), flush=True)
            if name in PREDICTED:
                predictions.append(predicted(name, found, Path(folder) / str(number) / "deeper", rng))
                print("  predicted: " + " | ".join(map(str, predictions[-1])), flush=True)
    if options.record:
        tables = [ResultTable("Moduli", COLUMNS, tuple(rows)), ResultTable("Predictions", PREDICTED_COLUMNS, tuple(predictions))]
        write_record("marker_identification", tables)


if __name__ == "__main__":
    main()
