"""CT images of the markers and their binarisation, Figures 3.33 to 3.41 of the 2008 report :cite:p:`hirai2008`, on a virtual scanner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from naibu import datasets
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.markers import Markers
from naibu.core.volume import Volume
from naibu.reproduction.chapter3.experiment import EXPERIMENT
from naibu.validation.scanners.ct_mr import STEEL_WASHER, VirtualObject, empty_grid, scan
from naibu.validation.scanners.imaging_artifacts import CTDevice
from naibu.validation.scanners.motions import Still
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

LAYER_NAMES = ("first (hardness 0)", "second (hardness 0)", "third (hardness 5)", "fourth (hardness 5)")
STATES = ("initial", "deformed")
MARKERS = 25  # in a layer
VOXEL_MM = (0.29, 0.29, 0.5)  # Table 3.6
REACH_MM = 9.0  # gel beside the outermost markers that is shown
SLAB_MM = 1.5  # above and below the markers of a layer; the image is the brightest of the slices
GEL = 1040.0
NEIGHBOURS_MM = 12.5  # nearer in the initial state than across a square of 10 mm


@dataclass(frozen=True, slots=True, eq=False)
class LayerImage:
    """The image of a layer of markers in one state.

    Attributes
    ----------
    layer, state : int, str
        Which: 0 to 3, and ``"initial"`` or ``"deformed"``.
    image : Volume
        One slice, the brightest values over the layer.
    binary : ndarray, shape (ny, nx)
        Where it is brighter than half way from gel to steel.
    ids : ndarray, shape (k,), int64
        Markers with a printed position, trusted or completed.
    printed : ndarray, shape (k, 2)
        Their positions, mm.
    found : ndarray, shape (k, 2)
        Centre of the bright spot at each, mm; NaN where there is none.
    """

    layer: int
    state: str
    image: Volume
    binary: BoolArray
    ids: IntArray
    printed: FloatArray
    found: FloatArray


def layer_images(seed: int = 0) -> tuple[LayerImage, ...]:
    """Scan the four layers of markers of the experiment in both states, at the printed positions."""
    experiment = datasets.load(EXPERIMENT)
    return tuple(
        _layer_image(layer, state, experiment.state(state).markers, 10 * seed + 2 * layer + k)
        for layer in range(len(LAYER_NAMES))
        for k, state in enumerate(STATES)
    )


def _layer_image(layer: int, state: str, markers: Markers | None, seed: int) -> LayerImage:
    assert markers is not None  # all are bundled
    known = np.isfinite(markers.points).all(axis=1) & ((markers.ids - 1) // MARKERS == layer)
    points, ids = markers.points[known], markers.ids[known]
    middle, half = 0.5 * (points.max(axis=0) + points.min(axis=0))[:2], 0.5 * np.ptp(points[:, :2], axis=0) + REACH_MM
    body = VirtualObject.of(lambda at: np.where((np.abs(at[:, :2] - middle) < half).all(axis=1), GEL, 0.0), points, STEEL_WASHER, ids=ids)
    margin = np.array([REACH_MM + 2.0, REACH_MM + 2.0, SLAB_MM])
    grid = empty_grid(points.min(axis=0) - margin, points.max(axis=0) + margin, VOXEL_MM)
    seen = scan(body, Still(), grid, CTDevice(), seed=seed, samples=1).volume
    brightest = seen.values.max(axis=0, keepdims=True)
    image = Volume.from_array(brightest, spacing_mm=grid.spacing_mm, origin_mm=grid.origin_mm)
    gel = float(np.median(brightest[brightest > 0.5 * GEL]))
    binary = np.asarray(brightest[0] > 0.5 * (gel + float(brightest.max())))
    return LayerImage(layer, state, image, binary, ids, points[:, :2], _spots(image, binary, points[:, :2]))


def _spots(image: Volume, binary: BoolArray, at: FloatArray) -> FloatArray:
    """Return the centre (k, 2), mm, of the spot nearest to each position (k, 2), within half a washer; NaN where there is none."""
    closed = ndimage.binary_closing(binary, iterations=2)
    labels, count = ndimage.label(closed)
    found = np.full(at.shape, np.nan)
    if count:
        centres = np.array(ndimage.center_of_mass(closed, labels, range(1, count + 1)))[:, ::-1]
        places = image.origin_mm[:2] + centres * image.spacing_mm[:2]
        distance, nearest = cKDTree(places).query(at)
        which = np.asarray(nearest)
        near = distance < 0.5 * STEEL_WASHER.diameter_mm
        found[near] = places[which[near]]
    return found


def spacing_change(before: LayerImage, after: LayerImage) -> float:
    """Return the mean ratio of the distances of neighbouring markers, deformed over initial, from the centres of their spots."""
    common, one, two = np.intersect1d(before.ids, after.ids, return_indices=True)
    a, b = before.found[one], after.found[two]
    pairs = np.argwhere(np.triu(np.ones((len(common), len(common)), dtype=bool), 1))
    old, new = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (a, b))
    counted = (old < NEIGHBOURS_MM) & np.isfinite(new)
    return float((new[counted] / old[counted]).mean())


def images_of_markers(seed: int = 0) -> Section:
    """Return the images of the four layers before and after, with what is found in them."""
    images = layer_images(seed)
    rows: list[tuple[Cell, ...]] = []
    for before, after in zip(images[::2], images[1::2], strict=True):
        counts = [(int(np.isfinite(i.found[:, 0]).sum()), len(i.ids)) for i in (before, after)]
        off = [float(np.sqrt(np.nanmean(((i.found - i.printed) ** 2).sum(axis=1)))) for i in (before, after)]
        rows.append((LAYER_NAMES[before.layer], *(f"{n} of {k}" for n, k in counts), *off, spacing_change(before, after)))
    columns = ("layer", "found, initial", "found, deformed", "off, initial, RMS mm", "off, deformed, RMS mm", "spacing, deformed / initial")
    growth = [float(r[5]) for r in rows if isinstance(r[5], float)]
    clear = min(growth[:2]) > max(growth[2:])
    text = (
        "The CT volumes are lost; the positions of the markers are printed. Washers of steel (outer diameter 2.8 mm) are put there, in gel "
        f"that ends {REACH_MM:g} mm beside the outermost, and scanned by a virtual CT scanner with the voxels of Table 3.6. Images show "
        "the brightest of the slices of a layer, as the markers of one are not all in one slice. Markers whose position is not legible "
        "are missing.",
        f"The report says that markers move apart in all layers, and {'' if clear else 'other than here '}more in the gel of hardness 0: "
        f"spacings grow to {growth[0]:.3f} and {growth[1]:.3f} of what they were in it, and to {growth[2]:.3f} and {growth[3]:.3f} in that "
        "of hardness 5.",
    )
    table = Table("Marker images", columns, tuple(rows), caption="Spots in the binarised images against the printed positions.")
    whole = Figure("Fig. 3.33", "Printed positions of the markers seen from the side: before, and after.", _side_view, (8.0, 3.4))
    figures = [whole]
    for k, name in enumerate(LAYER_NAMES):
        pair = images[2 * k : 2 * k + 2]
        figures.append(
            Figure(
                f"Figs. 3.{34 + 2 * k}, 3.{35 + 2 * k}",
                f"The {name.split()[0]} layer: image and binarised image, initial (above) and deformed.",
                lambda canvas, shown=pair: _draw(canvas, shown),  # type: ignore[misc]
                (7.0, 7.0),
            )
        )
    return Section("CT images of the markers (3.6.2)", text, (table,), tuple(figures))


def _side_view(canvas: Canvas) -> None:
    experiment = datasets.load(EXPERIMENT)
    for axis, state in zip(canvas.subplots(1, 2, sharex=True, sharey=True), STATES, strict=True):
        markers = experiment.state(state).markers
        assert markers is not None
        layer = (markers.ids - 1) // MARKERS
        for soft, label, mark in ((True, "hardness 0", "o"), (False, "hardness 5", "s")):
            chosen = (layer < 2) == soft
            axis.plot(markers.points[chosen, 0], markers.points[chosen, 2], mark, ms=4, label=label)
        axis.set(title=state, xlabel="x, mm", aspect="equal")
    canvas.axes[0].set_ylabel("z, mm")
    canvas.axes[1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw(canvas: Canvas, shown: tuple[LayerImage, ...]) -> None:
    for row, own in zip(canvas.subplots(2, 2), shown, strict=True):
        ny, nx = own.binary.shape
        (x0, y0), (dx, dy) = own.image.origin_mm[:2], own.image.spacing_mm[:2]
        extent = (x0 - 0.5 * dx, x0 + (nx - 0.5) * dx, y0 - 0.5 * dy, y0 + (ny - 0.5) * dy)
        row[0].imshow(own.image.values[0], cmap="gray", origin="lower", extent=extent)
        row[1].imshow(own.binary, cmap="gray", origin="lower", extent=extent)
        row[0].set(title=f"{own.state}: CT image", xlabel="x, mm", ylabel="y, mm")
        row[1].set(title=f"{own.state}: binarised", xlabel="x, mm")
