"""Chapter 1 of :cite:t:`hirai2008`: inner deformation of a calf from MR images, with section 3.5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.imaging.displacement.accuracy import end_point_error, intensity_rms, moved_back
from naibu.imaging.preprocessing.rigid_registration import RigidRegistration, rigid_displacement
from naibu.reproduction.chapter1 import figures as drawn
from naibu.reproduction.chapter1.calf_motion import leg_pose
from naibu.reproduction.chapter1.calf_phantom import CalfCase, calf_case
from naibu.reproduction.chapter1.flow import flow_section
from naibu.reproduction.chapter1.matching import (
    RIGHT_MM,
    WAYS,
    CheckPoints,
    Matched,
    candidates_of,
    check_points,
    continued,
    judged,
    judged_slices,
    matched,
    picked_registration,
    under_noise,
)
from naibu.reproduction.chapter1.paper_matches import PAPER_SLICES, paper_section
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

DEFAULT_NAME = "naibu's default"
STOPS = {"max_iterations was reached": "alpha reached 10"}
NOISE_LEVELS = (0.0, 10.0, 20.0)


@dataclass(frozen=True, slots=True, eq=False)
class Calf:
    """The volumes and all results: the middle slice as an image, matches in both, and the field of the default method.

    Attributes
    ----------
    case, image : CalfCase
        Volumes, and their middle slice.
    plane, space : list of Matched
        Correlation alone and the four strengths, in the image and in the volumes.
    counts : tuple of tuple of int
        Interest points of the reference and the deformed state, in the image and in the volumes.
    candidates : tuple of int
        Candidate pairs.
    rigid : RigidRegistration
        Motion of the tibia in the volumes from picked points.
    default : ndarray, shape (nz, ny, nx, 3)
        Displacement by the default method of naibu, mm; NaN outside the object.
    """

    case: CalfCase
    image: CalfCase
    plane: list[Matched]
    space: list[Matched]
    counts: tuple[tuple[int, int], tuple[int, int]]
    candidates: tuple[int, int]
    rigid: RigidRegistration
    default: FloatArray


def chapter1(
    seed: int = 0,
    *,
    pixels: int = 256,
    slices: int = 15,
    plane_points: tuple[int, int] = (200, 240),
    space_points: tuple[int, int] = (1000, 5000),
    draws: int = 4,
    paper_slices: tuple[int, ...] = PAPER_SLICES,
) -> Chapter:
    """Reproduce chapter 1 and section 3.5 on a phantom in place of the volumes of the report, which are lost.

    Parameters
    ----------
    seed : int
        Of texture and noise.
    pixels, slices : int
        Along x and y, and scanned; the report has 256 and 29, to which 28 are added by interpolation.
    plane_points, space_points : tuple of int
        Interest points of the reference and the deformed state, in the image and in the volumes.
    draws : int
        Realisations of noise, for the table of matches under noise.
    paper_slices : tuple of int
        Slices, with the interpolated ones, of the volumes in which the paper's 500 points are matched.
    """
    calf = examined(calf_case(seed, pixels=pixels, slices=slices), plane_points, space_points)
    sections = (
        _case_section(calf),
        _plane_section(calf, draws, seed),
        _space_section(calf),
        paper_section(seed, pixels=pixels, slices=paper_slices),
        flow_section(calf.case, calf.image, {DEFAULT_NAME: calf.default}),
    )
    nz, ny, nx = calf.case.reference.shape
    settings: dict[str, Cell] = {"seed": seed, "voxels": f"{nx} x {ny} x {nz}", "draws": draws}
    return Chapter("ch1", "Chapter 1: inner deformation of a calf from MR images (and section 3.5)", sections, settings)


def examined(case: CalfCase, plane_points: tuple[int, int] = (200, 240), space_points: tuple[int, int] = (1000, 5000)) -> Calf:
    """Match points in the middle slice and in the volumes by every strength, and correlate the volumes."""
    from naibu.imaging.volume_correlation.correlate import correlate_volumes

    image = case.slices(case.reference.shape[0] // 2)
    found: list[list[Matched]] = []
    numbers, points = [], []
    rigid = picked_registration(case)
    for each, counts, motion in ((image, plane_points, picked_registration(image)), (case, space_points, rigid)):
        pairs, before, after = candidates_of(each.reference, each.deformed, counts, motion.transform)
        found.append([matched(each, pairs, way) for way in (None, *WAYS)])
        numbers.append(len(pairs))
        points.append((len(before), len(after)))
    default = correlate_volumes(case.reference, case.deformed).displacement.vectors
    return Calf(case, image, found[0], found[1], (points[0], points[1]), (numbers[0], numbers[1]), rigid, default)


def _case_section(calf: Calf) -> Section:
    case = calf.case
    nz, ny, nx = case.reference.shape
    length = np.linalg.norm(case.truth[case.leg], axis=-1)
    inner = np.linalg.norm(leg_pose().inverse().applied(_places(case) + case.truth[case.leg]) - _places(case), axis=-1)
    text = (
        "The report's MR volumes of a volunteer's calf are lost. They are replaced by a phantom of a calf (skin, fat, muscles with septa, "
        "tibia and fibula with marrow, vessels, textures that move with the tissue), scanned by a virtual MR scanner with noise, blur, "
        "uneven sensitivity and another gain in the second scan: slices 2 mm apart, one interpolated between each two, 256 intensity "
        "levels. A plate compresses it from below; tissue preserves its volume, the bones move rigidly, the tibia by "
        f"{leg_pose().angle_deg:.1f} degrees. The true motion of every point is known, which it was not in the report.",
        f"Here {nx} x {ny} x {nz} voxels (the report: 256 x 256 x 57). Tissue moves by {np.median(length):.1f} mm (median) and up to "
        f"{length.max():.1f} mm, {inner.max() / case.reference.spacing_mm[0]:.0f} pixels after the motion of the bone is removed. "
        "The numbers of the report are shown for comparison of the quantities; they need not agree.",
        "As in the report the bone's motion comes from points picked by hand: here voxels on the rim of the tibia, to half a voxel.",
    )
    figure = Figure("Figs. 1.3, 3.21", "The middle slice before and after, and the true displacement.",
                    drawn.the_case(case, nz // 2), (10.5, 3.6))  # fmt: skip
    return Section("The case", text, (_registration(calf),), (figure,))


def _places(case: CalfCase) -> FloatArray:
    where = np.argwhere(case.leg)[:, ::-1]
    return case.reference.to_physical(where)


def _registration(calf: Calf) -> Table:
    rows: list[tuple[Cell, ...]] = []
    bone = calf.case.reference.to_physical(np.argwhere(calf.case.of("bone"))[:, ::-1])
    tibia = bone[bone[:, 0] < 5.0]
    plane = picked_registration(calf.image)
    middle = calf.image.reference.origin_mm[2]
    slab = tibia[np.abs(tibia[:, 2] - middle) < 1e-6]
    for name, found, points, axes in (
        ("image: three points (3.36)", plane, slab, 2),
        ("volumes: eighteen points (Horn)", calf.rigid, tibia, 3),
    ):
        off = np.linalg.norm((found.transform.applied(points) - leg_pose().applied(points))[:, :axes], axis=1)
        rows.append((name, found.transform.angle_deg, found.rms_mm, float(off.mean()), float(off.max())))
    columns = ("registration", "angle, degrees", "residual at the points, RMS mm", "error over the tibia, mean mm", "largest, mm")
    note = f"The true motion rotates the leg by {leg_pose().angle_deg:.2f} degrees, 3.00 of them within the slices."
    caption = "Motion of the tibia from points picked to the nearest voxel, against the true one."
    return Table("Registration", columns, tuple(rows), caption=caption, note=note)


def _plane_section(calf: Calf, draws: int, seed: int) -> Section:
    points = check_points(calf.image)
    chosen = [next(m for m in calf.plane if m.name == name) for name in ("direction", "chen")]
    back = {m.name: m.moved_back(points.deformed_mm, calf.image.reference) for m in chosen}
    text = (
        "TPA, the report's approach in images, is the strength 'direction' (1.6); RFM is 'chen'. The printed 101 iterations are what "
        "alpha makes when it grows from 0 to 10 by a tenth; (1.6) has no alpha, and nothing changes after a few iterations.",
        "The strengths hardly differ where few wrong candidates compete, and where many do the directional ones are not better than "
        "Chen's: what they share, that neighbours agree on distances, is what helps. All find more right matches than correlation alone. "
        "That the report's approach is better than Chen's, as it concludes from 72 against 63 matches, is not seen here.",
    )
    figures = (
        Figure("Matches", "From reference points to their matches, on the deformed slice.",
               drawn.match_panels(calf.image, chosen), (9.0, 4.5)),
        Figure("Energy", "Energy (1.5), and number of matches, in every iteration.",
               drawn.energies({"image": calf.plane[1:], "volumes": calf.space[1:]}), (9.0, 4.6)),
        Figure("Fig. 1.4", "Delaunay net, dense field inside it, and its error.", drawn.net_panels(calf.image, chosen), (10.5, 6.6)),
        Figure("Fig. 1.5", "Check points moved back from the deformed slice.", drawn.check_panels(calf.image, points, back),
               (9.0, 4.0)),
    )  # fmt: skip
    tables = (_table_1_1(calf), _table_of_noise(calf, draws, seed), _table_1_2(calf, points))
    return Section("Two slices (1.4)", text, tables, figures)


def _table_1_1(calf: Calf) -> Table:
    _, printed = printed_table("1.1")
    rows: list[tuple[Cell, ...]] = [(f"paper, {r[0]}", r[1], r[2], None, r[4], r[5], "", None, None, None) for r in printed]
    inside = calf.image.leg
    for way in calf.plane:
        found = way.matches
        error = end_point_error(np.where(way.dense.valid[..., None], way.dense.vectors, np.nan), calf.image.truth, inside)
        relaxation = way.name != "correlation alone"
        rows.append(
            (f"ours, {way.name}", *calf.counts[0], calf.candidates[0], len(found), len(found.energies) if relaxation else 0,
             STOPS.get(found.stop, found.stop) if relaxation else "", way.right_percent, error.median_mm, 100.0 * error.coverage)
        )  # fmt: skip
    columns = (
        "way", "points before", "points after", "candidate pairs", "matches", "iterations", "ended because",
        f"right within {RIGHT_MM:g} mm, %", "dense field, median error, mm", "tissue inside the net, %",
    )  # fmt: skip
    note = (
        "The table's printed title, 'Error of the checking points', belongs to Table 1.2. Times, printed as 5 s for both, depend on the "
        "machine and are left out; the relaxation takes milliseconds today."
    )
    return Table("Table 1.1", columns, tuple(rows), caption="Matches of interest points in two slices.", note=note)


def _table_of_noise(calf: Calf, draws: int, seed: int) -> Table:
    found = under_noise(calf.image, calf.counts[0], NOISE_LEVELS, draws, seed)
    names = list(dict.fromkeys(r.way for r in found))
    rows: list[tuple[Cell, ...]] = []
    for start in range(0, len(found), len(names)):
        group = found[start : start + len(names)]
        case = (group[0].noise, "by bone" if group[0].registered else "no, wider search", group[0].candidates)
        rows.append((*case, "right matches", *(r.right for r in group)))
        rows.append((*case, "of all, %", *(r.right_percent for r in group)))
    columns = ("added noise, SD in intensity levels", "registered", "candidate pairs", "", *names)
    caption = "The same slices with noise added, registered first or searched in a box 2.75 times as wide."
    return Table("Matches under noise", columns, tuple(rows), caption=caption, note=f"Means over {draws} draws of the noise.")


def _table_1_2(calf: Calf, points: CheckPoints) -> Table:
    _, printed = printed_table("1.2")
    rows = [(f"paper, {r[0]}", *r[1:11], r[11], *_two_means(np.array(r[1:11]))) for r in printed]
    for way in calf.plane[1:]:
        cm = np.round(0.1 * points.errors_mm(way.moved_back(points.deformed_mm, calf.image.reference)), 3)
        rows.append((f"ours, {way.name}", *cm.tolist(), None, *_two_means(cm)))
    ends = moved_back(continued(calf.default, calf.case.reference), calf.case.reference, calf.case.motion.to_space(points.reference_mm))
    cm = np.round(0.1 * points.errors_mm(ends), 3)
    rows.append((DEFAULT_NAME + ", volumes", *cm.tolist(), None, *_two_means(cm)))
    columns = (
        "way",
        *(f"EP{i}, cm" for i in range(10)),
        "printed RMSE, cm",
        "RMS, cm",
        "root of mean",
    )
    note = (
        "The printed RMSE does not follow from the printed errors: 0.396 and 0.417 are the roots of their means, without the square; "
        "their root mean squares are 0.180 and 0.202 cm. Our check points are the strongest interest points 3 mm under the skin and at "
        "least 15 mm apart; their true deformed positions are known. A point may also be among the matches, as the report's with "
        "0.000 may have been. They are moved back by the net of the matched deformed points; outside it by the affine motion that fits all "
        "matches."
    )
    return Table("Table 1.2", columns, tuple(rows), caption="Ten check points moved back: distance from where they were.", note=note)


def _two_means(errors: FloatArray) -> tuple[float, float]:
    return round(float(np.sqrt(np.mean(errors**2))), 3), round(float(np.sqrt(np.mean(errors))), 3)


def _space_section(calf: Calf) -> Section:
    case = calf.case
    nz = case.reference.shape[0]
    chosen = [next(m for m in calf.space if m.name == name) for name in ("direction26", "chen")]
    everywhere = np.asarray(np.isfinite(calf.default).all(axis=-1))
    fields = {
        chosen[0].name: (chosen[0].dense.vectors, chosen[0].dense.valid),
        "default": (calf.default, everywhere),
    }
    whole = {"direction26": chosen[0].dense.vectors, "default": continued(calf.default, case.reference)}
    which = [round(fraction * (nz - 1)) for fraction in (15 / 56, 30 / 56, 45 / 56)]
    text = (
        "The report's approach in volumes is the strength 'direction26' (1.23), RPFM is 'chen'. Both the report's and our matches of the "
        "two differ too little to prefer one: 26.00 against 26.35 intensity levels in the report.",
        "The RMS intensity residual (1.29) counts slices 10 to 50 of 57 as in the report, and in them the deformed tissue. It has a floor "
        "of noise and interpolation, which the true displacement shows, and is insensitive to errors where tissue is uniform: the error of "
        "the field against the truth is shown, too.",
    )
    figures = (
        Figure("Fig. 1.9", "Displacement of the nodes of the net.", drawn.node_displacements(chosen), (10.0, 4.0)),
        Figure("Fig. 1.10", "Dense field and error, in the middle slice and in a cut along the leg at x = 0.",
               drawn.cuts(case, fields, nz // 2), (10.0, 9.0)),
        Figure("Fig. 6 (paper)", "Deformed slices, the reference volume warped by the fields, and differences.",
               drawn.resampled_slices(case, whole, which), (9.0, 12.0)),
    )  # fmt: skip
    return Section("Volumes (Table 1.3 and Table I of the paper)", text, (table_1_3(calf),), figures)


def table_1_3(calf: Calf) -> Table:
    """Return Table 1.3 beside what strengths, the default and the truth give."""
    _, printed = printed_table("1.3")
    rows: list[tuple[Cell, ...]] = [(f"paper, {r[0]}", *r[1:5], r[5], *(None,) * 5) for r in printed]
    case = calf.case
    still = np.zeros_like(case.truth)
    rows.append(("ours, nothing moved", *(None,) * 4, *_judged(case, still, None), None))
    rows.append(
        ("ours, bone's motion alone", *(None,) * 4, *_judged(case, rigid_displacement(calf.rigid.transform, case.reference), None), None)
    )
    for way in calf.space:
        row = _judged(case, way.dense.vectors, way.dense.valid)
        rows.append((f"ours, {way.name}", *calf.counts[1], len(way.matches), len(way.net.simplices), *row, way.right_percent))
    rows.append((f"ours, {DEFAULT_NAME}", *(None,) * 4, *_judged(case, calf.default, None), None))
    true = np.where(case.leg[..., None], case.truth, np.nan)
    rows.append(("true displacement", *(None,) * 4, *_judged(case, true, None), None))
    columns = (
        "way", "points before", "points after", "matches", "tetrahedra", "RMS (1.29), intensity levels", "field: mean error, mm",
        "median, mm", "95 %, mm", "measured, %", "right, %",
    )  # fmt: skip
    first, last = judged_slices(case.reference).start, judged_slices(case.reference).stop - 1
    note = (
        f"Slices {first} to {last} of {case.reference.shape[0]}, tissue alone. Fields from matches are extrapolated outside their net by "
        "the affine motion that fits all matches, and evaluated there, too; 'measured' is the tissue inside the net. Where a field "
        "folds it has no inverse: such voxels do not count in the RMS, and are white in the figure below. Right matches lie within "
        f"{RIGHT_MM:g} mm of the truth."
    )
    return Table("Table 1.3", columns, tuple(rows), caption="Matches in volumes, the dense field, and the intensity residual.", note=note)


def _judged(case: CalfCase, vectors: FloatArray, measured: BoolArray | None) -> tuple[float, float, float, float, float]:
    before, after = judged(case)
    rms = intensity_rms(case.reference, case.deformed, continued(vectors, case.reference), region=after)
    error = end_point_error(vectors, case.truth, before)
    fraction = error.coverage if measured is None else float(measured[before].mean())
    return rms, error.mean_mm, error.median_mm, error.p95_mm, 100.0 * fraction
