"""Section 3.5 of :cite:t:`hirai2008` on the calf phantom: block matching, optical flow and their hybrid, in an image and a volume."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import MEASURES, Measure, block_matching
from naibu.imaging.dense_matching.hybrid import hybrid_flow
from naibu.imaging.dense_matching.optical_flow import AS_REPORTED, REPORT_LEVELS, horn_schunck, lucas_kanade
from naibu.imaging.displacement.accuracy import end_point_error
from naibu.imaging.preprocessing.resampling import resampled_to_grid
from naibu.imaging.preprocessing.rigid_registration import total_displacement
from naibu.reproduction.chapter1 import figures as drawn
from naibu.reproduction.chapter1.calf_phantom import CalfCase, Tissue
from naibu.reproduction.chapter1.matching import REPORT_PIXEL_MM, judged, picked_registration
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

Flow = Callable[[Volume, Volume], DisplacementField]
LEAST_RANGE, LOST_MM = 30.0, 5.0
LAMBDA, ITERATIONS = AS_REPORTED["data_weight"], AS_REPORTED["iterations"]
# of the report, voxels of its pixel size: image, volume
BLOCKS, SEARCHES = ((5, 5, 1), (3, 3, 3)), ((30, 35, 0), (15, 15, 1))
PARTS: tuple[tuple[str, tuple[Tissue, ...]], ...] = (
    ("all tissue", ("skin", "fat", "muscle", "bone")),
    ("skin and fat", ("skin", "fat")),
    ("muscle", ("muscle",)),
    ("bone", ("bone",)),
)
COLUMNS = (
    "method", "measured, % of tissue", "median error, mm", "mean error, mm", "95 % of errors below, mm",
    "mean error in skin and fat, mm", "in muscle, mm", "in bone, mm",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """The displacement (nz, ny, nx, 3) that a method found, mm, NaN where it measured nothing, and its distance from the truth."""

    name: str
    vectors: FloatArray
    errors_mm: FloatArray


def flow_section(case: CalfCase, image: CalfCase, others: Mapping[str, FloatArray]) -> Section:
    """Return the tables and pictures of section 3.5.

    Parameters
    ----------
    case : CalfCase
        The volumes.
    image : CalfCase
        One slice of them.
    others : mapping of str to ndarray, shape (nz, ny, nx, 3)
        Displacements of the volumes by further methods, mm.
    """
    plane = _measured(image, 0)
    space = _measured(case, 1) + [_against(name, np.where(case.leg[..., None], u, np.nan), case) for name, u in others.items()]
    region = judged(case)[0]
    at = case.reference.shape[0] // 2
    lost = 100.0 * float(np.mean(plane[0].errors_mm[np.isfinite(plane[0].errors_mm)] > LOST_MM))
    text = (
        "As in the report the two states are first registered by points on the tibia (3.36). 'As the report' stands for its "
        "settings: whole voxels; templates of 5 x 5 pixels searched for within 30 and 35 pixels in the image, 3 x 3 x 3 voxels within 15, "
        "15 and 1 in the volume; templates with an intensity range up to 30 left out; Horn-Schunck with lambda = 4 and 40 "
        "iterations; one grid. The report takes zero where nothing was measured; here such voxels are left out of the "
        "errors, and their fraction is shown.",
        "The report judges by eye: block matching for the skin, Horn-Schunck for the inside. In the image the mean errors in skin and "
        "fat, and in muscle, confirm that; but neither measures the calf. Most templates are found well, as the median shows, and "
        f"{lost:.0f} % of them end more than {LOST_MM:g} mm off. Horn-Schunck on one grid cannot follow motions "
        "of ten pixels. The hybrid takes the result of block matching wherever there is contrast, wrong matches included, and is no better "
        "than block matching alone. Unlike in the report Lucas-Kanade errs less than Horn-Schunck on one grid.",
        "Coarse-to-fine grids change the order: Horn-Schunck is then better in every tissue than any method on one grid, and digital "
        "volume correlation, with rigid inclusions for the bones and a dilatation penalty, is better still.",
    )
    note = "Errors are lengths of vectors against the true motion of the tissue, where the method measured."
    tables = (
        Table("Section 3.5, image", COLUMNS, tuple(_row(m, image, None) for m in plane), caption="One slice, errors within it.", note=note),
        Table(
            "Section 3.5, volume",
            COLUMNS,
            tuple(_row(m, case, region) for m in space),
            caption="The volume, slices that count as in Table 1.3.",
            note=note,
        ),
    )
    chosen = [m for m in plane if not m.name.startswith(("SSD", "NCC"))]
    figures = (
        Figure("Figs. 3.26-3.28, 3.30", "Displacement in the image, motion of the bone included, and its error; gray: not "
               "measured.", drawn.flow_panels(image, chosen, 0), (10.0, 12.0)),
        Figure("Fig. 3.30, volume", "The same by methods in three dimensions, in the middle slice.",
               drawn.flow_panels(case, space, at), (10.0, 12.0)),
    )  # fmt: skip
    return Section("Section 3.5: block matching and optical flow", text, tables, figures)


def _measured(case: CalfCase, kind: int) -> list[Measured]:
    """Run all methods of an image (kind 0) or a volume (kind 1)."""
    rigid = picked_registration(case).transform
    back = resampled_to_grid(case.deformed, case.reference, through=rigid.applied)
    return [_one(name, flow(case.reference, back), case, rigid) for name, flow in _flows(case, kind).items()]


def _one(name: str, found: DisplacementField, case: CalfCase, rigid: RigidTransform) -> Measured:
    known = np.where(found.valid[..., None] & case.leg[..., None], found.vectors, np.nan)
    return _against(name, total_displacement(known, rigid, case.reference), case)


def _against(name: str, vectors: FloatArray, case: CalfCase) -> Measured:
    return Measured(name, vectors, np.linalg.norm(vectors - case.truth, axis=-1))


def _flows(case: CalfCase, kind: int) -> dict[str, Flow]:
    finer = REPORT_PIXEL_MM / case.reference.spacing_mm[0]
    block = BLOCKS[kind]
    search = (*(round(n * finer) for n in SEARCHES[kind][:2]), SEARCHES[kind][2])

    def blocks(measure: Measure) -> Flow:
        return lambda a, b: block_matching(
            a, b, block=block, search=search, measure=measure, sub_voxel=False, least_range=LEAST_RANGE, mask=case.leg
        )

    def hybrid(a: Volume, b: Volume) -> DisplacementField:
        return hybrid_flow(
            a, b, block=block, search=search, sub_voxel=False, least_range=LEAST_RANGE, mask=case.leg, data_weight=LAMBDA,
            full_scale=REPORT_LEVELS, iterations=ITERATIONS, warps=1, levels=1,
        )  # fmt: skip

    size = " x ".join(str(n) for n in block if n > 1)
    measures: tuple[Measure, ...] = tuple(MEASURES) if kind == 0 else ("sad",)
    flows: dict[str, Flow] = {f"{m.upper()}, {size}, as the report": blocks(m) for m in measures}
    flows["Horn-Schunck, as the report"] = lambda a, b: horn_schunck(a, b, full_scale=REPORT_LEVELS, **AS_REPORTED)
    if kind == 0:
        flows["Lucas-Kanade, as the report"] = lambda a, b: lucas_kanade(a, b, levels=1, warps=1, damping=0.0, median_filter=False)
    flows["hybrid, as the report"] = hybrid
    flows["Lucas-Kanade, coarse to fine"] = lambda a, b: lucas_kanade(a, b, mask=case.leg)
    flows["Horn-Schunck, coarse to fine"] = lambda a, b: horn_schunck(a, b, mask=case.leg)
    return flows


def _row(found: Measured, case: CalfCase, region: BoolArray | None) -> tuple[Cell, ...]:
    means: list[Cell] = []
    whole: list[Cell] = []
    for name, kinds in PARTS:
        where = case.of(*kinds) if region is None else case.of(*kinds) & region
        e = end_point_error(found.vectors, case.truth, where)
        if name == "all tissue":
            whole = [100.0 * e.coverage, e.median_mm, e.mean_mm, e.p95_mm]
        else:
            means.append(e.mean_mm)
    return (found.name, *whole, *means)
