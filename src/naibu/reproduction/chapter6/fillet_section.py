"""What fillets of the chip's corners bear: a table of radii, and the envelope of safe loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.sensing_chip.analysis import ChipAnalysis
from naibu.applications.sensing_chip.fillets import FilletedEnd
from naibu.applications.sensing_chip.load_envelope import load_envelope, load_limits
from naibu.viewer.chapters.chapter import Figure
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


def fillet_table(analysis: ChipAnalysis, ends: Sequence[FilletedEnd]) -> Table:
    """Return stress concentration and largest loads of radii, beside those of nominal stress."""
    nominal = load_limits(analysis.design)
    rows: list[tuple[Cell, ...]] = [("nominal, no concentration", 1.0, 1.0, float(nominal[0]), float(nominal[1]))]
    for end in ends:
        factors, limits = end.concentration(analysis.beams), end.load_limits(analysis.beams)
        rows.append((f"{1e3 * end.fillet_mm:g} µm", *(float(v) for v in factors), float(limits[0]), float(limits[1])))
    return Table(
        "Fillets",
        ("radius of the corners", "concentration, F_z", "concentration, M_y", "F_z borne, mN", "M_x or M_y borne, N µm"),
        tuple(rows),
        caption="Corners beside and below the beams, rounded; each load alone.",
        note="Concentration: largest principal stress of finite elements of one end of a beam over the largest nominal stress. It is worst "
        "where the fillets beside and below the beam meet, and known within some 5 %; block and frame are rigid in what their ends bear.",
    )


def fillet_figure(
    analysis: ChipAnalysis, ends: Sequence[FilletedEnd], loads: Sequence[tuple[float, float]] = (), *, marked: str = "loads"
) -> Figure:
    """Return the envelope of safe loads with every radius, and loads (mN, N µm) as points."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        axes.plot(*load_envelope(analysis.design).T, "k--", label="nominal stress")
        for k, end in enumerate(ends):
            axes.plot(*end.envelope(analysis.beams).T, f"C{k}", label=f"fillets of {1e3 * end.fillet_mm:g} µm, moment about x or y")
            diagonal = end.envelope(analysis.beams, azimuth_deg=45.0)
            axes.plot(*diagonal.T, f"C{k}:", label=f"fillets of {1e3 * end.fillet_mm:g} µm, moment about a diagonal")
        if loads:
            axes.plot(*np.array(loads).T, "kx", label=marked)
        axes.set(xlabel="$F_z$ (mN)", ylabel="moment (N µm)", xlim=(0, None), ylim=(0, None))
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))

    strength = 1e-6 * analysis.design.strength_kpa
    return Figure("Safe loads with fillets", f"Largest force and moment together, at a strength of {strength:g} GPa.", draw, (9.5, 4.2))
