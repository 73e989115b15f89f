"""What ``identify`` does with displacement fields, alone and beside experiments with markers."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from naibu.cli.shell.console import GRAVE, NOT_EXPLAINED, print_table, progress_display, say
from naibu.cli.shell.described import labels_of
from naibu.cli.shell.run_record import found, wrote
from naibu.core.errors import InputError

if TYPE_CHECKING:
    from naibu.identification.from_markers.specimen.specimen_model import ModelSettings

Unit = Literal["mm", "cm", "m", "um", "inch"]
ContactModel = Literal["coulomb", "stick", "springs"]
PixelScale = Literal["given", "sought"]
Joined = Literal["tied", "sliding"]
Law = Literal["neo_hookean", "neo_hookean_isochoric", "mooney_rivlin", "yeoh", "saint_venant_kirchhoff"]
# operands that can only be displacement fields
FIELD_FILES = (
    *(".h5", ".hdf5", ".tfm", ".mha", ".mhd", ".nrrd", ".nhdr", ".nii", ".gz"),
    *(".vtu", ".mat", ".csv", ".tsv", ".txt", ".xlsx", ".dat", ".tif", ".tiff"),
)


def identify_from_fields(
    fields: Sequence[str],
    *,
    mask: Path | None,
    zones: Path | None,
    zone_name: Sequence[str],
    known: Sequence[str],
    law: Law,
    each_cell: bool,
    loaded: Sequence[str],
    element_size_mm: float,
    unit: Unit | None,
    spacing_mm: tuple[float, float, float] | None,
    node_spacing: tuple[float, float, float] | None,
    check_components: bool,
    out: Path,
    overwrite: bool,
) -> None:
    """Identify moduli from displacement fields, and print them."""
    from naibu.workflows.fields.identify_fields import identify_fields, table_of_assumptions, table_of_zones

    if law != "neo_hookean":
        raise InputError(f"law={law!r} is not known for fields; use 'neo_hookean'")
    began = time.perf_counter()
    with progress_display() as progress:
        result = identify_fields(
            fields, mask=mask, zones=zones, zone_names=labels_of(zone_name), known=known, loaded=loaded, each_cell=each_cell,
            element_size_mm=element_size_mm, unit=unit, spacing_mm=spacing_mm, node_spacing=node_spacing,
            check_components=check_components, out=out, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    usable = result.estimate.verdict is None or result.estimate.verdict.ok
    for number, line in enumerate(result.notes):
        say(line, "dim" if number else "bold" if usable else GRAVE)
    for table in (table_of_zones(result), table_of_assumptions(result)):
        if table.rows:
            print_table(table.title, table.columns, table.rows, digits=4)
    wrote(*result.files)
    found(usable=usable)
    say(f"{time.perf_counter() - began:.0f} s. Results in {out}: open report.html; naibu predict, live and cut take model.json.")
    if not usable:
        say("The model does not explain the data: the results are marked as not to be used.", GRAVE)
        sys.exit(NOT_EXPLAINED)


def identify_from_both(
    experiments: Sequence[str],
    fields: Sequence[str],
    *,
    known: Sequence[str],
    states: dict[str, list[str]] | None,
    settings: ModelSettings,
    mask: Path | None,
    zones: Path | None,
    zone_name: Sequence[str],
    loaded: Sequence[str],
    unit: Unit | None,
    spacing_mm: tuple[float, float, float] | None,
    node_spacing: tuple[float, float, float] | None,
    check_components: bool,
    out: Path,
    overwrite: bool,
) -> None:
    """Identify moduli from experiments with markers and displacement fields together, and print them."""
    from naibu.workflows.joint_identification import identify_jointly

    began = time.perf_counter()
    with progress_display() as progress:
        result = identify_jointly(
            experiments, fields, known=known, states=states, settings=settings, mask=mask, zones=zones, zone_names=labels_of(zone_name),
            loaded=loaded, unit=unit, spacing_mm=spacing_mm, node_spacing=node_spacing, check_components=check_components,
            element_size_mm=settings.element_size_mm, out=out, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    for line in result.notes:
        say(line, GRAVE if result.joint.contradicted else "bold")
    table = result.table
    print_table(table.title, table.columns, table.rows, digits=4)
    say(table.note, "dim")
    wrote(*result.files)
    found(usable=result.usable)
    told = f"Results in {out}: open report.html; naibu predict takes model.json; each kind by itself is in markers and fields."
    say(f"{time.perf_counter() - began:.0f} s. {told}")
    if not result.usable:
        say("A model does not explain the data: the results are marked as not to be used.", GRAVE)
        sys.exit(NOT_EXPLAINED)
