"""Figures of chapter 5."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.ischemia.layered_response import SkinMotion
from naibu.core.arrays import ComplexArray, FloatArray
from naibu.reproduction.chapter5.ischemia import DURATION_S, THRESHOLD_KPA, Response

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]
LINES = ("-", "--", "-.", ":")


def indentations(fine: Sequence[Response], coarse: Sequence[Response]) -> Draw:
    """Draw the indentation of converged meshes and of the printed grid against time."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, 2)
        for axis, found, title in zip(
            axes, (fine, coarse), ("converged mesh, load on 1 mm", "printed grid, force on one node"), strict=True
        ):
            for response, line in zip(found, LINES, strict=False):
                axis.plot(response.times, response.indentation, line, label=response.name, lw=1.3)
            axis.axvline(DURATION_S, color="0.8", lw=0.8, zorder=0)
            axis.set(title=title, xlabel="time, s", ylabel="indentation, mm", xlim=(0.0, 1.5), ylim=(0.0, None))
        axes[0].legend(frameon=False, fontsize=8)

    return draw


def response_curves(motion: SkinMotion, area: FloatArray, release_s: float, record: FloatArray | None = None) -> Draw:
    """Draw indentation and pale area over time, with a measured record (t, 2) where there is one."""

    def draw(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        if record is not None:
            left.plot(record[:, 0], record[:, 1], ".", color="0.6", ms=3, label="measured")
        left.plot(motion.times, motion.indentation, lw=1.3, label="model")
        right.plot(motion.times, area, lw=1.3)
        for axis in (left, right):
            axis.axvline(release_s, color="0.8", lw=0.8, zorder=0)
            axis.set(xlabel="time, s", ylim=(0.0, None))
        left.set_ylabel("indentation, mm")
        right.set_ylabel("pale area, mm$^2$")
        if record is not None:
            left.legend(frameon=False, fontsize=8)

    return draw


def pale_areas(found: Sequence[Response]) -> Draw:
    """Draw the area in which the pressure exceeds that of capillaries against time, and the pressure along the surface."""

    def draw(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        for response, line in zip(found, LINES, strict=False):
            motion = response.motion
            if motion is None:
                continue
            left.plot(1e3 * motion.times, motion.pale_area(THRESHOLD_KPA), line, label=response.name, lw=1.3)
            radius = np.sqrt(np.cumsum(motion.areas) / np.pi)
            for time, shade in ((0.002, 0.4), (0.46, 1.0)):
                row = motion.pressure[int(np.argmin(np.abs(motion.times - time)))]
                right.plot(
                    radius,
                    row,
                    line,
                    color="C0" if response is found[0] else "C1",
                    alpha=shade,
                    lw=1.3,
                    label=f"{response.name}, {1e3 * time:g} ms",
                )
        right.axhline(THRESHOLD_KPA, color="0.6", lw=0.8)
        left.set(xlabel="time, ms", ylabel="pale area, mm$^2$", xlim=(-10.0, 560.0), ylim=(0.0, None), title=f"above {THRESHOLD_KPA:g} kPa")
        right.set(xlabel="radius, mm", ylabel="pressure below the surface, kPa", xlim=(0.0, 1.6), title="pressure")
        left.legend(frameon=False, fontsize=8)
        right.legend(frameon=False, fontsize=7)

    return draw


def bode_diagram(frequencies: FloatArray, found: Mapping[str, ComplexArray], from_time: Mapping[float, complex]) -> Draw:
    """Draw amplitude and phase of the indentation for an oscillating force."""

    def draw(canvas: Canvas) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True)
        for (name, values), line in zip(found.items(), LINES, strict=False):
            upper.loglog(frequencies, np.abs(values), line, lw=1.3, label=name)
            lower.semilogx(frequencies, np.degrees(np.angle(values)), line, lw=1.3)
        if from_time:
            at, points = np.array(list(from_time)), np.array(list(from_time.values()))
            upper.loglog(at, np.abs(points), "k.", label="from the time domain")
            lower.semilogx(at, np.degrees(np.angle(points)), "k.")
        upper.set_ylabel("amplitude, mm/mN")
        lower.set(xlabel="frequency, Hz", ylabel="phase, degrees", yticks=(-90, -60, -30, 0))
        upper.legend(frameon=False, fontsize=8)

    return draw
