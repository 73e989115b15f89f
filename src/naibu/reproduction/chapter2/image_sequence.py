"""Successive MR images of one cross-section, Figure 2.7 of the 2008 report :cite:p:`hirai2008`, on a virtual scanner."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.reproduction.chapter2.simulations import MR_SIZE_MM, Study, agar_under_bar
from naibu.validation.scanners.ct_mr import PLASTIC_BEAD, VirtualObject, scan
from naibu.validation.scanners.imaging_artifacts import MRDevice
from naibu.validation.scanners.motions import MeshMotion
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

BETWEEN_S, IMAGES = 0.6, 6
PUSHED_S, HELD_S, RELEASED_S, PUSH_MM = 1.0, 1.5, 2.5, 2.0
PIXEL_MM, SLICE_MM = 0.5, 2.0
BEADS = ((-13.0, 17.0), (0.0, 16.0), (0.0, 9.0), (20.0, 20.0))  # in the cross-section, mm
AGAR_SIGNAL = 600.0


def sequence_section(seed: int = 0) -> Section:
    """Return images of the cross-section under the bar 0.6 s apart, while it is pressed and released, and the beads found in them."""
    study = agar_under_bar(push_mm=PUSH_MM, path_s=(PUSHED_S, HELD_S, RELEASED_S))
    times = np.round(BETWEEN_S * np.arange(IMAGES), 6)
    images, rows = list[Volume](), list[tuple[Cell, ...]]()
    for number, time in enumerate(times):
        image, true = _imaged(study, float(time), seed + number)
        found = _dark_spots(image, true)
        off = np.linalg.norm(found - true, axis=1)
        rows.append((float(time), int(np.isfinite(off).sum()), len(BEADS), float(np.nanmax(off)), float(true[1, 1] - BEADS[1][1])))
        images.append(image)
    columns = ("time, s", "beads found", "of", "largest error, mm", "true motion of the bead under the bar, mm")
    text = (
        "The second way of the report takes one cross-section again and again, 0.6 s apart, while the bar is pushed down and lifted. Its "
        "images are lost; here the simulated cross-section is imaged by a virtual MR scanner (pixels of "
        f"{PIXEL_MM:g} mm, a slice of {SLICE_MM:g} mm). Depth, times and places of the beads are not printed and are assumed: "
        f"{PUSH_MM:g} mm down within {PUSHED_S:g} s, lifted from {HELD_S:g} to {RELEASED_S:g} s. Motion during an image is left out.",
        "Beads give no signal. As the report says, the markers can be located in every image.",
    )
    table = Table("Fig. 2.7, beads", columns, tuple(rows), caption="Centres of the dark spots against the true ones.")
    figure = Figure(
        "Fig. 2.7", "One cross-section every 0.6 s: the bar presses and is lifted.", lambda canvas: _draw(canvas, images, times), (9.0, 4.2)
    )
    return Section("One cross-section every 0.6 s", text, (table,), (figure,))


def _imaged(study: Study, time_s: float, seed: int) -> tuple[Volume, FloatArray]:
    """Return the image of the cross-section, and the true centres of the beads (k, 2), mm."""
    at = int(np.argmin(np.abs(study.series.times - time_s)))
    motion = MeshMotion(*_thick(study.mesh, study.series.displacement[at]))
    beads = np.column_stack([np.array(BEADS), np.zeros(len(BEADS))])
    body = VirtualObject.of(lambda x: np.where(np.isfinite(x).all(axis=1), AGAR_SIGNAL, 0.0), beads, PLASTIC_BEAD)
    half, height = 0.5 * MR_SIZE_MM[0] + 3.0, MR_SIZE_MM[1]
    low = np.array([-half, -2.0, 0.0])
    shape = (1, round((height + 5.0) / PIXEL_MM), round(2.0 * half / PIXEL_MM))
    grid = Volume.from_array(np.zeros(shape, np.uint8), spacing_mm=(PIXEL_MM, PIXEL_MM, SLICE_MM), origin_mm=low)
    seen = scan(body, motion, grid, MRDevice(), seed=seed, samples=(1, 1, 2))
    return seen.volume, motion.to_space(beads)[:, :2]


def _thick(mesh: Mesh, displacement: FloatArray) -> tuple[Mesh, FloatArray]:
    """Return the cross-section as prisms, split into tetrahedra, and the displacement of their nodes: the same in the whole thickness."""
    n = mesh.n_points
    points = np.concatenate([np.column_stack([mesh.points, np.full(n, z)]) for z in (-SLICE_MM, SLICE_MM)])
    a, b, c = np.sort(mesh.cells, axis=1).T
    cells = np.concatenate(
        [np.column_stack([a, b, c, c + n]), np.column_stack([a, b, b + n, c + n]), np.column_stack([a, a + n, b + n, c + n])]
    )
    corners = points[cells]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    cells[turned] = cells[turned][:, [0, 2, 1, 3]]
    flat = np.column_stack([displacement, np.zeros(n)])
    return Mesh.from_arrays(points, cells, "tetra"), np.concatenate([flat, flat])


def _dark_spots(image: Volume, near: FloatArray) -> FloatArray:
    """Return the centre (k, 2), mm, of the dark spot within 2 mm of each place (k, 2); NaN where there is none."""
    values = image.values[0].astype(float)
    dark = values < 0.7 * float(np.median(values[values > 0.5 * AGAR_SIGNAL]))
    filled = np.asarray(ndimage.binary_opening(~dark, iterations=1))
    inside = np.asarray(ndimage.binary_fill_holes(filled))
    labels, count = ndimage.label(dark & inside)
    found = np.full(near.shape, np.nan)
    for k in range(1, count + 1):
        weight = np.where(labels == k, float(np.median(values[filled])) - values, 0.0)
        row, column = ndimage.center_of_mass(weight)
        place = image.origin_mm[:2] + np.array([column, row]) * image.spacing_mm[:2]
        distance = np.linalg.norm(near - place, axis=1)
        if distance.min() < PLASTIC_BEAD.diameter_mm:
            found[int(np.argmin(distance))] = place
    return found


def _draw(canvas: Canvas, images: list[Volume], times: FloatArray) -> None:
    axes = canvas.subplots(2, IMAGES // 2, sharex=True, sharey=True)
    for axis, image, time in zip(axes.ravel(), images, times, strict=True):
        ny, nx = image.shape[1:]
        (x0, y0), (dx, dy) = image.origin_mm[:2], image.spacing_mm[:2]
        extent = (x0 - 0.5 * dx, x0 + (nx - 0.5) * dx, y0 - 0.5 * dy, y0 + (ny - 0.5) * dy)
        axis.imshow(image.values[0], cmap="gray", origin="lower", extent=extent)
        axis.set(title=f"{time:.1f} s", xlabel="x from the middle, mm")
    for axis in axes[:, 0]:
        axis.set_ylabel("height, mm")
