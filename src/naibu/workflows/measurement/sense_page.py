"""The page of a measured displacement: what to know first, slices with overlays, and figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import AnyFloatArray, BoolArray
from naibu.imaging.displacement.strain import green_lagrange_strain_of
from naibu.imaging.preprocessing.resampling import warped
from naibu.viewer.cards import Card
from naibu.viewer.slices import Overlay, SliceView
from naibu.viewer.tables import Table

if TYPE_CHECKING:
    from naibu.workflows.measurement.sense import Pair, SenseRun


def slice_view(pair: Pair, run: SenseRun) -> SliceView:
    """Return the slices of the page of a run."""
    measured, grid = run.measured, pair.reference
    box = _box(measured.mask)
    u = measured.displacement.vectors
    back = warped(pair.deformed, np.nan_to_num(u), grid)
    inside = measured.mask & np.isfinite(measured.gradient).all(axis=(-2, -1))
    gradient = measured.gradient[inside]
    principal, ratio = np.linalg.eigvalsh(green_lagrange_strain_of(gradient)), np.linalg.det(np.eye(3) + gradient)
    overlays = [
        Overlay("displacement, mm", np.linalg.norm(u[box], axis=-1)),
        Overlay("largest principal Green-Lagrange strain", _placed(principal[:, 2], inside)[box]),
        Overlay("smallest principal Green-Lagrange strain", _placed(principal[:, 0], inside)[box]),
        Overlay("volume ratio J", _placed(ratio, inside)[box], middle=1.0),
    ]
    if (sd := measured.displacement.largest_sd_mm) is not None:
        overlays.append(Overlay("standard deviation of the displacement, mm", np.where(measured.mask, sd, np.nan)[box]))
    if measured.strain_sd is not None:
        overlays.append(Overlay("standard deviation of a component of strain", np.where(measured.mask, measured.strain_sd, np.nan)[box]))
    images = [("reference", pair.reference.values), ("deformed", pair.deformed.values), ("deformed, warped back", back)]
    return SliceView(
        title=f"Displacement from {pair.names[0]} to {pair.names[1]}",
        sentences=_sentences(run),
        spacing_mm=grid.spacing_mm,
        images=[(name, np.asarray(v, dtype=np.float32)[box]) for name, v in images],
        displacement=u[box] @ grid.direction,
        overlays=overlays,
        tables=[_table(run)],
        origin_mm=grid.to_physical([b.start for b in box[::-1]]) @ grid.direction,
        difference=(("reference minus deformed", 0, 1), ("reference minus deformed, warped back", 0, 2)),
        direction=grid.direction,
        cards=_cards(run, principal),
    )


def _placed(values: AnyFloatArray, where: BoolArray) -> AnyFloatArray:
    """Return values (n,) at some voxels (nz, ny, nx), and NaN elsewhere."""
    out = np.full(where.shape, np.nan, np.float32)
    out[where] = values
    return out


def middle_slice(pair: Pair, run: SenseRun) -> list[tuple[str, AnyFloatArray, str]]:
    """Return fields (ny, nx) of the slice across z with most of the object, each with its name and colour map."""
    measured = run.measured
    z = int(np.argmax(measured.mask.sum(axis=(1, 2))))
    inside = measured.mask[z] & np.isfinite(measured.gradient[z]).all(axis=(-2, -1))
    strain = np.full(inside.shape, np.nan)
    strain[inside] = np.linalg.eigvalsh(green_lagrange_strain_of(measured.gradient[z][inside]))[:, 2]
    size = np.where(measured.mask[z], np.linalg.norm(measured.displacement.vectors[z], axis=-1), np.nan)
    fields: list[tuple[str, AnyFloatArray, str]] = [
        ("displacement (mm)", size, "viridis"), ("largest principal Green-Lagrange strain", strain, "viridis"),
    ]  # fmt: skip
    if (sd := measured.displacement.largest_sd_mm) is not None:
        fields.append(("standard deviation (mm)", np.where(measured.mask[z], sd[z], np.nan), "cividis"))
    return fields


def _cards(run: SenseRun, principal: AnyFloatArray) -> tuple[Card, ...]:
    """Return what to know first; `principal` are the principal Green-Lagrange strains (n, 3) inside the object, in increasing order."""
    f = run.figures
    sd = f["median_sd_mm"]
    cards = [
        Card("Displacement, median", f"{f['median_displacement_mm']:.3g} mm", f"at most {f['largest_displacement_mm']:.3g} mm"),
        Card("Standard deviation of it", "not stated" if sd is None else f"{sd:.2g} mm", "median, along the least certain direction"),
    ]
    if len(principal):
        low, high = (f"{100.0 * np.median(principal[:, k]):+.1f}".replace("-", "−") for k in (0, 2))
        known = f["median_strain_sd"]
        certain = f"; standard deviation of a component {100.0 * known:.2g} %" if isinstance(known, float) else ""
        cards.append(Card("Principal strains, median", f"{low}, {high} %", f"smallest and largest, Green-Lagrange{certain}"))
    if isinstance(share := f["measured_fraction"], float):
        rest = "the rest is left unanswered" if share < 1.0 else "all of it"
        cards.append(Card("Part of the object measured", f"{100.0 * share:.1f} %", rest))
    before, after = f["initial_residual_rms"], f["residual_rms"]
    if isinstance(before, float) and isinstance(after, float) and before > 0.0:
        cards.append(
            Card(
                "Difference of the scans explained",
                f"{100.0 * (1.0 - (after / before) ** 2):.0f} %",
                "of its mean square, inside the object",
            )
        )
    if (error := f.get("p95_error_mm", f.get("p95_check_point_error_mm"))) is not None:
        cards.append(Card("Error against the truth, 95th percentile", f"{error:.3g} mm"))
    return tuple(cards)


def _box(mask: BoolArray, margin: int = 4) -> tuple[slice, ...]:
    inside = np.argwhere(mask)
    return tuple(slice(max(0, int(a) - margin), int(b) + 1 + margin) for a, b in zip(inside.min(axis=0), inside.max(axis=0), strict=True))


def _sentences(run: SenseRun) -> list[str]:
    f = run.figures
    folded = f["folded_fraction"] if isinstance(f["folded_fraction"], float) else 0.0
    folds = folded > 0.0
    share, doubts = f["measured_fraction"], folds + len(run.measured.warnings)
    where = f"{100.0 * share:.1f} % of the object" if isinstance(share, float) and share < 0.995 else "the whole object"
    reserved = (
        "without reservation" if not doubts else "with one reservation, below" if doubts == 1 else f"with {doubts} reservations, below"
    )
    name = "digital volume correlation" if run.measured.method == "default" else run.measured.method
    sentences = [
        f"Measured in {where}, {reserved}.",
        f"Method: {name}, {run.seconds:.1f} s. The object moved by {f['median_displacement_mm']:.2f} mm (median), at most "
        f"{f['largest_displacement_mm']:.2f} mm; the intensity residual inside it fell from {f['initial_residual_rms']:.4g} to "
        f"{f['residual_rms']:.4g} (root mean square).",
    ]
    if f["median_sd_mm"] is not None:
        sentences.append(
            f"The standard deviation of the displacement is {f['median_sd_mm']:.3f} mm (along the least certain direction, median)"
            + (f", that of a component of strain {f['median_strain_sd']:.2g}." if f["median_strain_sd"] is not None else ".")
        )
    else:
        sentences.append("This method states no uncertainty.")
    if isinstance(share, float) and share < 0.995:
        sentences.append(
            f"The displacement of {100.0 * (1.0 - share):.1f} % of the object was not measured: that part lies outside one of the "
            "scans, or in its padding, or the scans show no common texture there."
        )
    if folds:
        sentences.append(f"The field folds at {100.0 * folded:.2f} % of the voxels: it is wrong there.")
    return sentences + [text.replace("`", "") for text in run.measured.warnings]


def _table(run: SenseRun) -> Table:
    return Table("Figures", ("quantity", "value"), tuple(run.rows()))
