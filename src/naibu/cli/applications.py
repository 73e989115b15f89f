"""Verbs of applications: ``mammography``, ``decode-forces``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from naibu.cli.shell.console import WARNING, print_table, say
from naibu.cli.shell.described import Out, Overwrite, Whole
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import SCANS, SIMULATE, verb
from naibu.core.errors import InputError


@verb(SCANS, "mammography --cc cc.csv --mlo mlo.csv --thickness-mm 52,55 --angle-deg 45 --point-cc 40,12 --open")
def mammography(
    *,
    cc: Path | None = None,
    mlo: Path | None = None,
    thickness_mm: str = "",
    angle_deg: float | None = None,
    point_cc: Annotated[str, Parameter(allow_leading_hyphen=True)] = "",
    point_mlo: Annotated[str, Parameter(allow_leading_hyphen=True)] = "",
    mr: Path | None = None,
    side: Literal["left", "right"] | None = None,
    mr_axial: Path | None = None,
    mr_sagittal: Path | None = None,
    point_mr: Annotated[str, Parameter(allow_leading_hyphen=True)] = "",
    constrain_outlines: bool = False,
    pixel_mm: float | None = None,
    model: Literal["geometric", "mechanical"] = "geometric",
    unresolved_mm: float = 6.0,
    draws: Whole = 100,
    seed: Whole = 0,
    out: Out = Path("naibu-mammography"),
    overwrite: Overwrite = False,
) -> None:
    """Predict where a point of one mammographic view, or of an MR scan, lies in the other view, and where in the breast a lesion lies.

    Research software, not a medical device. At least one point is needed; with one in both views, the position of the lesion is estimated.

    Parameters
    ----------
    cc
        The breast in CC: a DICOM mammogram; or its outline, a CSV table of points along the skin, in mm, perpendicular to the chest
        wall and along it, laterally; or a mask (PNG, TIFF, MetaImage, NRRD, NIfTI), lateral side up, whose breast touches the side of
        the image that is the chest wall.
    mlo
        The same in MLO, upper side up.
    thickness_mm
        Distance of the compression plates, mm: one number, or CC,MLO. By default that of the mammograms' tags.
    angle_deg
        Positioner angle of MLO against CC, degrees: 20 to 90. By default that of the tags.
    point_cc
        Point X,Y in CC, mm, in the coordinates of the outline; of images, from the lower left corner, hung as masks are.
    point_mlo
        Point X,Y in MLO.
    mr
        Mask of the breast in an MR volume (NIfTI, MetaImage, NRRD): its shape is used instead of the one that the outlines imply.
    side
        Which breast the MR mask holds.
    mr_axial
        Instead of a mask of the volume: the unloaded breast in an axial maximum intensity projection of it, an outline or a mask as
        of CC.
    mr_sagittal
        The same in a sagittal projection, upper side up as in MLO.
    point_mr
        Point X,Y,Z in the MR volume, mm (LPS), to be shown in CC and MLO; with projections X,Y in the axial outline, and Z upwards in the
        sagittal one.
    constrain_outlines
        Scale the equilibria of an MR shape onto the widths of the outlines in CC and MLO (mechanical model).
    pixel_mm
        Size of a pixel of the masks, mm, where the files do not state it.
    model
        Closed geometric maps (within a second), or equilibrium of finite elements (some ten seconds).
    unresolved_mm
        Standard deviation of displacements in a view that no parameter describes, mm: heterogeneous tissue, positioning.
    draws
        Number of models drawn from the uncertainty of the parameters.
    seed
        Seed of the random numbers.
    out
        Folder for mammography.html, mammography.json and breast.html.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.workflows.applications.mammography import relate_views

    run = relate_views(
        cc,
        mlo,
        thickness_mm=_numbers("thickness_mm", thickness_mm) if thickness_mm else None,
        angle_deg=angle_deg,
        point_cc=_numbers("point_cc", point_cc) if point_cc else None,
        point_mlo=_numbers("point_mlo", point_mlo) if point_mlo else None,
        mr=mr,
        side=side,
        mr_axial=mr_axial,
        mr_sagittal=mr_sagittal,
        point_mr=_numbers("point_mr", point_mr) if point_mr else None,
        constrain_outlines=constrain_outlines,
        pixel_mm=pixel_mm,
        model=model,
        unresolved_mm=unresolved_mm,
        draws=draws,
        seed=seed,
        out=out,
        overwrite=overwrite,
    )
    print_table("naibu mammography", ("quantity", "value"), run.rows, left=True)
    wrote(*run.files)
    for warning in run.warnings:
        say(warning, WARNING)
    say(f"Page: {run.files[0]}   in 3-D: {run.files[2]}   numbers: {run.files[1]}")


@verb(SIMULATE, "decode-forces results/my_finger-decoder.json readings.csv --open")
def decode_forces(
    decoder: Path,
    readings: Path,
    *,
    free_rows: Whole = 20,
    noise_share: float = 1.0,
    friction: float | None = None,
    touch_s: float = 1.0,
    out: Out = Path("naibu-forces"),
    overwrite: Overwrite = False,
) -> None:
    """Decode recorded readings of a soft fingertip into forces, directions and places with intervals.

    Parameters
    ----------
    decoder
        NAME-decoder.json, which naibu simulate writes of a fingertip.
    readings
        CSV table of time, s, and the readings of F_z, M_x and M_y, V.
    free_rows
        So many rows at the beginning are of a free fingertip: their mean is the first offset, which is recalibrated while nothing touches;
        0 for readings without offset.
    noise_share
        Noise of the readings over that of the decoder's electronics: 1 unfiltered, 0.23 after a first-order filter with r = 0.1.
    friction
        Coefficient of static friction between what touches and the gel: says when the contact slides.
    touch_s
        How long after it begins a contact is taken to be undragged, s: sideways forces count from there.
    out
        Folder for forces.html, forces.json and forces.csv.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.workflows.applications.decode_forces import decode_forces as decoded

    run = decoded(
        decoder, readings, out=out, free_rows=free_rows, noise_share=noise_share, friction=friction, touch_s=touch_s, overwrite=overwrite
    )
    print_table("naibu decode-forces", ("quantity", "value"), run.rows, left=True)
    wrote(*run.files)
    say(f"Page: {run.files[0]}   numbers: {run.files[1]}   table: {run.files[2]}")


def _numbers(name: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{name} is {text!r}: needs numbers separated by commas, such as 52.0,31.5") from None
