"""Decode recorded readings of a fingertip into forces with intervals: a table of readings in, a table of forces and a page out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu.applications.fingertip.decoder import DecodedForces, ForceDecoder
from naibu.applications.fingertip.offset import OffsetTracker
from naibu.applications.fingertip.slip import SidewaysForces
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.tables.number_table import read_numbers
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.notebook import WrittenResult
from naibu.viewer.tables import Cell, Table
from naibu.workflows.applications.slip_report import drawn_rows, slip_card, slip_section, slip_summary, slip_words
from naibu.workflows.applications.stored_decoder import stored_detector
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

MOST_VOLTS = 100.0  # several times what amplifiers give
UNANSWERED = "nothing touches, or force or tilt lie beyond the training"
FAR_BEYOND = 10.0  # times the largest reading of the training, from which a table is in another unit, or another fingertip's

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_COLUMNS = (
    "time_s", "force_N", "force_low_N", "force_high_N", "tilt_deg", "tilt_low_deg", "tilt_high_deg", "azimuth_deg", "cone_95_deg",
    "x_mm", "y_mm", "z_mm", "position_95_mm", "sideways_x", "sideways_y", "sideways_low", "sideways_high", "slip",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class DecodedRecord(WrittenResult):
    """What was decoded, and the files.

    Attributes
    ----------
    files : tuple of Path
        Page, numbers of the page, and the table of forces.
    rows : tuple of tuple
        Names and values for the console.
    """

    files: tuple[Path, ...]
    rows: tuple[tuple[str, str], ...]

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a reading: time, force, direction and point of contact with their 95 % bounds, as in ``forces.csv``."""
        return self._rows_of("forces.csv")


@no_empty_folders()
def decode_forces(
    decoder: str | os.PathLike[str],
    readings: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    free_rows: int = 20,
    noise_share: float = 1.0,
    friction: float | None = None,
    touch_s: float = 1.0,
    overwrite: bool = False,
) -> DecodedRecord:
    """Decode a recording.

    Parameters
    ----------
    decoder : path-like
        ``NAME-decoder.json`` of `simulate`.
    readings : path-like
        CSV table of time, s, and the readings of F_z, M_x and M_y, V.
    out : path-like
        Folder for ``forces.html``, ``forces.json`` and ``forces.csv``.
    free_rows : int
        So many readings at the beginning are of a free fingertip: their mean is the first offset, which is recalibrated whenever nothing
        touches. 0: the readings have no offset.
    noise_share : float
        Standard deviation of the noise in the readings over that of the decoder's electronics: 0.23 after the report's filter.
    friction : float, optional
        Coefficient of static friction between what touches and the gel: says when the contact slides.
    touch_s : float
        How long after it begins a contact is taken to be undragged, s: sideways forces count from there.
    overwrite : bool
        Whether results that the folder holds are replaced.

    Raises
    ------
    InputError
        Files that cannot be used, times that do not grow, readings ten times beyond those of the decoder's training, fewer rows than
        `free_rows`, or a folder that cannot be written to.
    """
    if not 1e-3 <= noise_share <= 100.0:
        raise InputError(f"noise_share is {noise_share:g}; give a number from 0.001 to 100, 1 for unfiltered readings")
    if free_rows < 0:
        raise InputError(f"free_rows is {free_rows}; give a number of rows, or 0 where there is no offset")
    if friction is not None and not 0.01 <= friction <= 5.0:
        raise InputError(f"friction is {friction:g}; give the coefficient of static friction, from 0.01 to 5")
    if not 0.0 < touch_s < np.inf:
        raise InputError(f"touch_s is {touch_s:g}; give seconds, more than 0")
    source, table = Path(decoder), Path(readings)
    detector = stored_detector(source)
    chosen = detector.decoder
    rows = read_numbers(table, ("time, s", "F_z, V", "M_x, V", "M_y, V"), units=("s", "V", "V", "V"))
    if (np.diff(rows[:, 0]) <= 0.0).any():
        raise InputError(
            f"{table}: row {int(np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)[0]) + 2} is not later than the one before; sort them"
        )
    if (beyond := np.abs(rows[:, 1:]).max()) > MOST_VOLTS:
        raise InputError(f"{table}: a reading of {beyond:.3g} V is none of a fingertip (at most {MOST_VOLTS:g} V). Are its readings in V?")
    if free_rows > len(rows):
        raise InputError(
            f"free_rows is {free_rows}, and {table} has {len(rows)} rows; give at most so many, or 0 for readings without offset"
        )
    volts, offsets = _without_offset(chosen, rows[:, 1:], free_rows, noise_share)
    _require_near_training(table, chosen, volts)
    folder = output_folder(out, ("forces.html", "forces.json", "forces.csv"), overwrite=overwrite)
    found = chosen.decode(volts, noise_share=noise_share)
    sideways = detector.followed(rows[:, 0], volts / chosen.volts_per_load, noise_share=noise_share, touch_s=touch_s)
    csv = write_atomically(folder / "forces.csv", _csv(rows[:, 0], found, sideways, friction))
    settings: dict[str, Cell] = dict(input_record({"decoder": source, "readings": table}))
    sections = _section(rows[:, 0], found, offsets), slip_section(rows[:, 0], sideways, friction, touch_s)
    cards = _cards(found) if friction is None else (*_cards(found), slip_card(rows[:, 0], sideways, friction))
    page, numbers = write_chapter(Chapter("forces", "Forces decoded from readings", sections, settings, cards), folder)
    return DecodedRecord((page, numbers, csv), (*_summary(found), *slip_summary(rows[:, 0], sideways, friction)))


def _require_near_training(table: Path, decoder: ForceDecoder, volts: FloatArray) -> None:
    """Refuse readings (n, 3), V, less their offset, that no load near those of the training gives."""
    moment = decoder.limits[2] * decoder.unit[1]  # largest over F_z, mm
    most = np.abs(decoder.volts_per_load) * decoder.limits[1] * [1.0, moment, moment]
    row, channel = np.unravel_index(int(np.argmax(np.abs(volts) / most)), volts.shape)
    value, largest = float(volts[row, channel]), float(most[channel])
    if abs(value) >= FAR_BEYOND * largest:
        raise InputError(
            f"{table}: row {row + 2}: {('F_z', 'M_x', 'M_y')[channel]} of {value:.3g} V less its offset is {abs(value) / largest:.3g} "
            f"times the largest reading that the decoder was trained on, {largest:.3g} V; are the readings in V, and of this fingertip?"
        )


def _without_offset(decoder: ForceDecoder, volts: FloatArray, free_rows: int, noise_share: float) -> tuple[FloatArray, FloatArray]:
    """Return readings less the offset, and the offset (n, 3), V, at every row."""
    if free_rows == 0:
        return volts, np.zeros_like(volts)
    tracker = OffsetTracker(np.maximum(noise_share * decoder.noise * np.abs(decoder.volts_per_load), 1e-12))
    tracker.restart(volts[:free_rows])
    left, offsets = np.empty_like(volts), np.empty_like(volts)
    for k, reading in enumerate(volts):
        left[k] = tracker.without_offset(reading)
        offsets[k] = tracker.offset_volts
    return left, offsets


def _csv(times: FloatArray, found: DecodedForces, sideways: SidewaysForces, friction: float | None) -> str:
    columns = [
        times, 1e-3 * found.force_mn, *(1e-3 * found.force_95.T), found.tilt_deg, *found.tilt_95_deg.T, found.azimuth_deg,
        found.cone_95_deg, *found.position_mm.T, found.position_95_mm, *sideways.share.T, *sideways.size_95.T,
    ]  # fmt: skip
    table = np.stack(columns, axis=1)
    table[~found.answered, 1:] = np.nan
    words = slip_words(sideways, friction)
    lines = [",".join([*("" if np.isnan(v) else f"{v:.6g}" for v in row), word]) for row, word in zip(table, words, strict=True)]
    return "\n".join([",".join(_COLUMNS), *lines]) + "\n"


def _summary(found: DecodedForces) -> tuple[tuple[str, str], ...]:
    ok = found.answered
    if not ok.any():
        return (("readings answered", f"0 of {len(ok)}: {UNANSWERED}"),)
    top = int(np.nanargmax(found.force_mn))
    low, high = 1e-3 * found.force_95[top]
    return (
        ("readings answered", f"{int(ok.sum())} of {len(ok)}"),
        ("largest force, N", f"{1e-3 * found.force_mn[top]:.4g} ({low:.4g} to {high:.4g})"),
        ("its tilt, degrees", f"{found.tilt_deg[top]:.3g} ({found.tilt_95_deg[top, 0]:.3g} to {found.tilt_95_deg[top, 1]:.3g})"),
        ("its azimuth, degrees", f"{found.azimuth_deg[top] % 360.0:.4g}"),
    )


def _cards(found: DecodedForces) -> tuple[Card, ...]:
    ok = found.answered
    answered = Card("Readings answered", f"{100.0 * np.mean(ok):.0f} %", f"{int(ok.sum())} of {len(ok)}; in the others {UNANSWERED}")
    if not ok.any():
        return (answered,)
    top = int(np.nanargmax(found.force_mn))
    (low, high), tilt = 1e-3 * found.force_95[top], found.tilt_95_deg[top]
    return (
        Card("Largest force", f"{1e-3 * found.force_mn[top]:.3g} N", f"95 % interval {low:.3g} to {high:.3g} N"),
        Card("Its tilt", f"{found.tilt_deg[top]:.3g}°", f"95 % interval {tilt[0]:.3g} to {tilt[1]:.3g}°"),
        Card(
            "Its azimuth",
            f"{found.azimuth_deg[top] % 360.0:.3g}°" if tilt[0] > 0.0 else "not known",
            "" if tilt[0] > 0.0 else "the tilt may be 0",
        ),
        answered,
    )


def _without_wrap(azimuth_deg: FloatArray) -> FloatArray:
    """Return azimuths (n,), degrees, within half a turn of their circular mean; NaN stay."""
    turns = np.deg2rad(azimuth_deg)
    mean = np.rad2deg(np.arctan2(np.nansum(np.sin(turns)), np.nansum(np.cos(turns))))
    return np.asarray(mean + np.remainder(azimuth_deg - mean + 180.0, 360.0) - 180.0)


def _section(times: FloatArray, found: DecodedForces, offsets: FloatArray) -> Section:
    def draw(canvas: Canvas) -> None:
        force, tilt, azimuth = canvas.subplots(1, 3)
        rows = drawn_rows(len(times))
        at, azimuths = times[rows], _without_wrap(np.where(found.tilt_95_deg[:, 0] > 0.0, found.azimuth_deg, np.nan))
        force.fill_between(at, *(1e-3 * found.force_95[rows].T), alpha=0.3, linewidth=0)
        force.plot(at, 1e-3 * found.force_mn[rows], linewidth=0.8)
        tilt.fill_between(at, *found.tilt_95_deg[rows].T, alpha=0.3, linewidth=0)
        tilt.plot(at, found.tilt_deg[rows], linewidth=0.8)
        azimuth.plot(at, azimuths[rows], ".", markersize=2)
        for axes, name in ((force, "force (N)"), (tilt, "tilt (degrees)"), (azimuth, "azimuth (degrees)")):
            axes.set(xlabel="time (s)", ylabel=name)

    ok = found.answered
    text = (
        f"{int(ok.sum())} of {len(ok)} readings are answered; in the others {UNANSWERED}. Intervals hold 95 %. The decoder supposes a "
        "contact that presses towards the centre of the hemisphere; sideways drag is taken for another direction. An azimuth is shown "
        "where the tilt's interval excludes 0.",
    )
    summary = Table("Summary", ("quantity", "value"), _summary(found))
    drift = Table(
        "Offset", ("channel", "first, V", "last, V"),
        tuple((n, float(a), float(b)) for n, a, b in zip(("F_z", "M_x", "M_y"), offsets[0], offsets[-1], strict=True)),
        note="Recalibrated while nothing touches; a drift under a load cannot be told from the load.",
    )  # fmt: skip
    caption = f"With 95 % intervals; {len(drawn_rows(len(times)))} of {len(times)} readings."
    return Section("Forces", text, (summary, drift), (Figure("Forces", caption, draw, (11.0, 3.4)),) if ok.any() else ())
