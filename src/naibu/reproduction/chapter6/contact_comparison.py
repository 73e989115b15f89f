"""Presses of a soft fingertip beside theories of soft contact: force over depth, and contact radius over force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.fingertip.contact_theories import hertz_force, hertz_radius, parallel_springs_force, power_law
from naibu.applications.fingertip.fingertip import Fingertip
from naibu.applications.fingertip.pressing import Pressing
from naibu.core.arrays import BoolArray
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_LEAST = 0.02  # of the largest force: below, few points of the mesh touch
_FEWEST = 3


def theories_section(tip: Fingertip, names: Sequence[str], pressings: Sequence[Pressing]) -> Section:
    """Return the section that compares presses, before they slide, with Hertz, power laws and parallel springs.

    Parameters
    ----------
    tip : Fingertip
        What is pressed.
    names : sequence of str
        Of the presses.
    pressings : sequence of Pressing
        The presses.
    """
    chosen = [(name, p, _pressed(p)) for name, p in zip(names, pressings, strict=True)]
    chosen = [(name, p, pressed) for name, p, pressed in chosen if pressed.sum() >= _FEWEST]
    rows: list[tuple[Cell, ...]] = []
    for name, p, pressed in chosen:
        depth, force = p.depth_mm[pressed], p.along_rod_mn[pressed]
        c, gamma = power_law(force, p.contact_radius_mm[pressed])
        exponent = float(np.polyfit(np.log(depth), np.log(force), 1)[0])
        theory = (1e-3 * float(f(tip, depth[-1:])[0]) for f in (hertz_force, parallel_springs_force))
        rows.append((name, 1e-3 * float(force[-1]), *theory, exponent, gamma, c * 1e3**gamma))
    table = Table(
        "Theories of soft contact",
        ("press", "force, N", "Hertz at the same depth, N", "parallel springs, N", "exponent of the force over depth",
         "exponent of the contact radius over force", "contact radius at 1 N, mm"),
        tuple(rows),
        note="Hertz: exponents 1.5 and 1/3, of a half space at small strain. Parallel springs (Inoue, Hirai): exponent 2; the springs do "
        "not hinder each other's bulging, as a gel that keeps its volume on a base does. Soft fingers of power-law materials: "
        "a = c F^gamma with gamma up to 1/3 (Xydas and Kao).",
    )  # fmt: skip

    def draw(canvas: Canvas) -> None:
        _draw(canvas, tip, chosen)

    figure = Figure("Soft contact", "Force over depth, and contact radius over force, before a press slides.", draw, (10.0, 4.2))
    return Section("Against theories of soft contact", (), (table,), (figure,) if chosen else ())


def _pressed(p: Pressing) -> BoolArray:
    return np.asarray((p.slide_mm == 0.0) & (p.along_rod_mn > _LEAST * p.along_rod_mn.max()))


def _draw(canvas: Canvas, tip: Fingertip, chosen: Sequence[tuple[str, Pressing, BoolArray]]) -> None:
    deepest = max(float(p.depth_mm[pressed].max()) for _, p, pressed in chosen)
    strongest = max(float(p.along_rod_mn[pressed].max()) for _, p, pressed in chosen)
    left, right = canvas.subplots(1, 2)
    depths, forces = np.linspace(0.0, deepest, 100), np.linspace(0.0, strongest, 100)
    for name, p, pressed in chosen:
        left.plot(p.depth_mm[pressed], 1e-3 * p.along_rod_mn[pressed], ".-", markersize=4, linewidth=1.0, label=name)
        right.plot(1e-3 * p.along_rod_mn[pressed], p.contact_radius_mm[pressed], ".", markersize=4)
    left.plot(depths, 1e-3 * hertz_force(tip, depths), "k--", linewidth=1.2, label="Hertz")
    left.plot(depths, 1e-3 * parallel_springs_force(tip, depths), "k:", linewidth=1.5, label="parallel springs")
    right.plot(1e-3 * forces, hertz_radius(tip, forces), "k--", linewidth=1.2, label="Hertz")
    _, p, pressed = chosen[0]
    c, gamma = power_law(p.along_rod_mn[pressed], p.contact_radius_mm[pressed])
    right.plot(1e-3 * forces, c * forces**gamma, "C0", linewidth=1.0, label=f"a = c $F^{{{gamma:.2f}}}$, {chosen[0][0]}")
    right.set_ylim(0.0, None)
    left.set(xlabel="depth (mm)", ylabel="force along the rod (N)")
    right.set(xlabel="force along the rod (N)", ylabel="contact radius (mm)")
    for axes in (left, right):
        axes.legend(fontsize=7)
