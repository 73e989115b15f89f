"""A chest in air as computed tomography shows it: lungs full of air and vessels, an airway that is open to the outside, a table beneath."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions

Array = np.ndarray
AIR, LUNG, SOFT, BONE = -1000.0, -820.0, 40.0, 700.0
MIDDLE = np.array([176.0, 120.0, 80.0])


def chest_grid(shape: tuple[int, int, int] = (32, 64, 88), spacing: tuple[float, float, float] = (4.0, 4.0, 5.0)) -> Volume:
    return Volume.from_array(np.zeros(shape), spacing_mm=spacing)


def _ellipsoid(x: Array, centre: Array, radii: Array) -> Array:
    """Signed distance, mm, roughly: positive inside."""
    return (1.0 - np.linalg.norm((x - centre) / radii, axis=-1)) * min(radii)


def body(x: Array) -> Array:
    """Depth below the skin, mm, roughly; the trunk goes on beyond both ends of the scan."""
    return (1.0 - np.hypot((x[..., 0] - MIDDLE[0]) / 150.0, (x[..., 1] - MIDDLE[1]) / 95.0)) * 95.0


def lungs(x: Array) -> Array:
    """Depth in the lungs or the airway, mm, roughly. The airway opens through the front, in slices from 120 mm on."""
    both = [_ellipsoid(x, MIDDLE + np.array([s * 72.0, 0.0, -15.0]), np.array([52.0, 62.0, 78.0])) for s in (-1.0, 1.0)]
    airway = np.where(x[..., 2] > 60.0, 9.0 - np.hypot(x[..., 0] - MIDDLE[0], x[..., 1] - MIDDLE[1] + 10.0), -50.0)
    branch = 9.0 - np.hypot(x[..., 1] - MIDDLE[1] + 10.0, x[..., 2] - 66.0)
    branch = np.where(np.abs(x[..., 0] - MIDDLE[0]) < 60.0, branch, -50.0)
    mouth = 9.0 - np.hypot(x[..., 0] - MIDDLE[0], x[..., 2] - 134.0)
    mouth = np.where(x[..., 1] < MIDDLE[1] - 10.0, mouth, -50.0)
    return np.max([*both, airway, branch, mouth], axis=0)


def chest(grid: Volume, back: Callable[[Array], Array] = lambda x: x, *, noise: float = 20.0, seed: int = 0, table: bool = True) -> Volume:
    """Return a scan; `back` maps positions to the reference, the table stays where it is."""
    x = positions(grid)
    y = back(x)
    rng = np.random.default_rng(7)
    waves = rng.standard_normal((40, 3))
    waves *= (2 * np.pi / rng.uniform(14.0, 40.0, 40) / np.linalg.norm(waves, axis=1))[:, None]
    pattern = np.cos(y @ waves.T + rng.uniform(0, 2 * np.pi, 40)).sum(axis=-1) / np.sqrt(20.0)
    step = lambda d: 1.0 / (1.0 + np.exp(-d))  # noqa: E731
    tissue = SOFT + 15.0 * pattern
    spine = step(16.0 - np.hypot(y[..., 0] - MIDDLE[0], y[..., 1] - MIDDLE[1] - 62.0))
    tissue = tissue + spine * (BONE - SOFT)
    air = LUNG + 60.0 * pattern
    values = tissue + step(lungs(y)) * (air - tissue)
    values = AIR + step(body(y)) * (values - AIR)
    if table:
        values = np.where((x[..., 1] > 228.0) & (x[..., 1] < 244.0), 0.0, values)
    return grid.with_values(values + noise * np.random.default_rng(seed).standard_normal(values.shape))
