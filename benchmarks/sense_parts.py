"""Chests whose lungs slide: displacement of the whole by one field, and part by part, as `naibu sense` measures it.

Run: python benchmarks/sense_parts.py CASE.npz ...

Cases are those of thorax_case.py (--sliding) and of sense_volumes.py. Printed are, for all labels of a case and for the points that models
are fitted to, the mean, the median and the 95th percentile of the error, mm, and the part that the stated 95 % regions hold.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from naibu.core.volume import Volume
from naibu.imaging.measure_displacement import MeasuredDisplacement, measure_displacement, measured_by
from naibu.imaging.preprocessing.object_mask import object_mask
from naibu.imaging.volume_correlation.correlate import correlate_volumes

Array = NDArray[Any]
CHI_SQUARED_95 = 7.815  # three degrees of freedom
EVERY = 5  # voxels


def held(error: Array, covariance: Array) -> Array:
    """Return which errors (n, 3) lie in the 95 % regions of their covariance (n, 3, 3)."""
    regular = covariance + 1e-9 * np.eye(3)
    return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(regular, error[..., None])[..., 0]) < CHI_SQUARED_95)


def told(name: str, error: Array, covariance: Array) -> None:
    """Print a row."""
    if len(error):
        size = np.linalg.norm(error, axis=1)
        share = held(error, covariance).mean()
        print(f"  {name:16s} {size.mean():6.3f} / {np.median(size):.3f} / {np.percentile(size, 95):.3f}   held {share:6.1%}")


def scored(found: MeasuredDisplacement, truth: Array, labels: Array) -> None:
    """Print the errors of a displacement against the truth (nz, ny, nx, 3) by label (nz, ny, nx)."""
    valid = found.displacement.valid & (labels > 0)
    error, covariance = found.displacement.vectors - truth, found.displacement.covariance
    assert covariance is not None
    for label in (None, *np.unique(labels[labels > 0])):
        here = np.flatnonzero(valid if label is None else valid & (labels == label))[::EVERY]
        told("all" if label is None else f"label {label}", error.reshape(-1, 3)[here], covariance.reshape(-1, 3, 3)[here])
    if found.blocks is not None and found.blocks.covariance is not None:
        at = np.rint(found.displacement.grid.to_index(found.blocks.points)).astype(int)
        x, y, z = np.clip(at, 0, np.array(labels.shape[::-1]) - 1).T
        inside = labels[z, y, x] > 0
        told("points", (found.blocks.vectors - truth[z, y, x])[inside], found.blocks.covariance[inside])


def main() -> None:
    """Measure all cases both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", type=Path)
    for path in parser.parse_args().cases:
        case = np.load(path)
        scans = [Volume.from_array(np.ascontiguousarray(case[k].T), spacing_mm=case["spacing"]) for k in ("ref", "deformed")]
        truth, labels = case["u"].T, np.where(case["mask"], case["labels"], 0).T
        inside, began = object_mask(scans[0]), time.process_time()
        whole = measured_by(correlate_volumes(*scans), scans[0], inside)
        between = time.process_time()
        print(f"{path.stem}, one field, {between - began:.0f} s of the processor")
        scored(whole, truth, labels)
        found = measure_displacement(*scans)
        print(f"{path.stem}, part by part ({found.facts.get('parts', 1)} parts), {time.process_time() - between:.0f} s")
        scored(found, truth, labels)


if __name__ == "__main__":
    main()
