"""How close any smooth model could come to the markers: ``python benchmarks/noise_floor.py MODEL_FOLDER_OF_NAIBU_DEMO``.

A polynomial of increasing degree in the reference positions is added to the residuals of the calibrated model (``residuals.csv``). What
remains, with the degrees of freedom counted, approaches the noise of placing and reading the markers; the residual of markers left out of
the fit shows from which degree on it follows noise.
"""

from __future__ import annotations

import argparse
import csv
from itertools import product
from pathlib import Path

import numpy as np

from naibu import datasets

DEGREES = (0, 1, 2, 3)


def residuals(path: Path) -> dict[str, dict[int, np.ndarray]]:
    """Residuals (3,), mm, by load case and marker."""
    out: dict[str, dict[int, np.ndarray]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            values = [float(row[f"residual_{axis}_mm"] or "nan") for axis in "xyz"]
            out.setdefault(f"{row['experiment']}/{row['state']}", {})[int(row["marker"])] = np.array(values)
    return out


def smoothed(points: np.ndarray, residual: np.ndarray, degree: int) -> tuple[float, float]:
    """RMS distance left by a polynomial, per degree of freedom, and for markers that it did not see, mm."""
    x = (points - points.mean(axis=0)) / np.abs(points - points.mean(axis=0)).max(axis=0)
    powers = [e for e in product(range(degree + 1), repeat=3) if sum(e) <= degree]
    basis = np.stack([np.prod(x ** np.array(e), axis=1) for e in powers], axis=1)
    hat = basis @ np.linalg.pinv(basis)
    left = residual - hat @ residual
    unseen = left / (1.0 - np.diag(hat))[:, None]
    return float(np.sqrt((left**2).sum() / (len(x) - len(powers)))), float(np.sqrt((unseen**2).sum(axis=1).mean()))


def main() -> None:
    """Print one line for each load case and degree."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of results, with residuals.csv")
    for label, rows in residuals(parser.parse_args().folder / "residuals.csv").items():
        experiment = datasets.load(label.split("/")[0])
        ids = np.array([marker for marker, r in rows.items() if np.isfinite(r).all()])
        points = experiment.initial.aligned(ids)
        whole = np.isfinite(points).all(axis=1)
        residual = np.stack([rows[i] for i in ids])[whole]
        for degree in DEGREES:
            left, unseen = smoothed(points[whole], residual, degree)
            print(f"{label:28s} degree {degree}: {left:.3f} mm left, {unseen:.3f} mm for markers not seen")


if __name__ == "__main__":
    main()
