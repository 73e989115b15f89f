"""Figures of a pressed fingertip: its deformed section, readings over force, moments against each other, and decoded forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.fingertip.decoder import DecodedForces
from naibu.applications.fingertip.fingertip import PACKAGE
from naibu.applications.fingertip.pressing import FingertipModel, Pressing
from naibu.core.arrays import FloatArray
from naibu.meshing.surface import boundary_faces

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

CHANNELS = ("F_z", "M_x", "M_y")


def section(canvas: Canvas, model: FingertipModel, pressing: Pressing) -> None:
    """Draw the plane of symmetry at rest and at the largest force, coloured by the displacement, with the rod's end."""
    from matplotlib.collections import PolyCollection

    mesh = model.mesh
    faces = boundary_faces(mesh).faces
    cut = faces[(mesh.points[faces][:, :, 1] == 0.0).all(axis=1)]
    moved = pressing.displacement_mm[-1]
    axes = canvas.add_subplot()
    rest, now = mesh.points[:, [0, 2]], (mesh.points + moved)[:, [0, 2]]
    size = np.linalg.norm(moved[cut], axis=2).mean(axis=1)
    shown = PolyCollection(list(now[cut]), array=size, cmap="viridis", edgecolors="0.3", linewidths=0.2)
    axes.add_collection(shown)
    canvas.colorbar(shown, ax=axes, label="displacement (mm)", shrink=0.6)
    around = np.linspace(0.0, np.pi, 181)
    radius = model.fingertip.radius_mm
    axes.plot(radius * np.cos(around), radius * np.sin(around), "k:", linewidth=1.0, label="at rest")
    in_package = np.isin(cut, mesh.cells[mesh.regions == PACKAGE]).all(axis=1)
    axes.add_collection(PolyCollection(list(rest[cut[in_package]]), facecolors="C3", edgecolors="none", label="package of the chip"))
    axis = pressing.press.axis[[0, 2]]
    across = np.array([axis[1], -axis[0]])
    middle = (radius - pressing.depth_mm[-1]) * axis + pressing.slide_mm[-1] * across
    ends = np.stack([middle - 0.6 * radius * across, middle + 0.6 * radius * across])
    axes.plot(*ends.T, "C1", linewidth=3.0, label="end of the rod")
    axes.set(xlabel="in the plane of the tilt (mm)", ylabel="above the base (mm)", aspect="equal")
    axes.autoscale_view()
    canvas.legend(fontsize=8, loc="outside upper left", ncols=3)


def readings_over_force(canvas: Canvas, forces_n: Sequence[FloatArray], volts: Sequence[FloatArray], names: Sequence[str]) -> None:
    """Draw the three readings (n, 3), V, of presses over the force along the rod (n,), N."""
    for k, axes in enumerate(canvas.subplots(1, 3)):
        for force, reading, name in zip(forces_n, volts, names, strict=True):
            axes.plot(force, reading[:, k], ".-", markersize=3, linewidth=1.0, label=name)
        axes.set(xlabel="force along the rod (N)", ylabel=f"reading of ${CHANNELS[k]}$ (V)")
    spans = np.array([axes.get_ylim() for axes in canvas.axes[1:]])
    for axes in canvas.axes[1:]:
        axes.set_ylim(float(spans.min()), float(spans.max()))
    canvas.axes[0].legend(fontsize=7)


def moments(canvas: Canvas, curves: Mapping[str, FloatArray], unit: str = "V") -> None:
    """Draw M_y over M_x: curves (n, 2)."""
    from matplotlib import colormaps

    axes = canvas.add_subplot()
    if len(curves) > 10:  # the colours of the ordinary cycle
        axes.set_prop_cycle(color=colormaps["tab20"](range(20)))
    for name, values in curves.items():
        axes.plot(*values.T, ".-", markersize=3, linewidth=1.0, label=name)
    axes.axhline(0.0, color="0.7", linewidth=0.5)
    axes.axvline(0.0, color="0.7", linewidth=0.5)
    span = 1.1 * max((float(np.abs(values).max()) for values in curves.values()), default=1.0) or 1.0
    axes.set_aspect("equal")
    axes.set(xlim=(-span, span), ylim=(-span, span))
    axes.set(xlabel=f"$M_x$ ({unit})", ylabel=f"$M_y$ ({unit})")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))


def decoded(canvas: Canvas, found: Sequence[DecodedForces], forces: Sequence[FloatArray], tilts: Sequence[FloatArray]) -> None:
    """Draw decoded over true forces and tilts, with intervals, and true ones (n,), mN and degrees."""
    left, right = canvas.subplots(1, 2)
    for answer, force, tilt in zip(found, forces, tilts, strict=True):
        ok = answer.answered
        low, high = answer.force_95[ok].T
        left.errorbar(
            1e-3 * force[ok], 1e-3 * answer.force_mn[ok], 1e-3 * np.stack([answer.force_mn[ok] - low, high - answer.force_mn[ok]]), fmt=".",
            markersize=3, linewidth=0.6,
        )  # fmt: skip
        at, (below, above) = answer.tilt_deg[ok], answer.tilt_95_deg[ok].T
        right.errorbar(tilt[ok], at, np.stack([at - below, above - at]), fmt=".", markersize=3, linewidth=0.6)
    for axes, name in ((left, "force (N)"), (right, "tilt of the force (degrees)")):
        low, high = min(0.0, axes.get_xlim()[0]), axes.get_xlim()[1]
        axes.plot([low, high], [low, high], "k:", linewidth=0.8)
        axes.set(xlabel=f"true {name}", ylabel=f"decoded {name}")
