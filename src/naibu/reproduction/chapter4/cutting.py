"""Cutting of a scanned surface: Figures 16 to 18 of the 2008 report :cite:p:`hirai2008` (chapter 4.2)."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter1d

from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing.cutting.surfaces.surface_cut import SurfaceCutter, cut_surface
from naibu.meshing.cutting.surfaces.surface_result import Groove, SurfaceCut, groove
from naibu.reproduction.chapter4 import cutting_figures as figures
from naibu.simulation.surfaces.opening import opening
from naibu.simulation.surfaces.springs import CutSprings
from naibu.validation.specimens.hand import hand_surface
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

EDGE_MM, NOISE_MM = 3.0, 0.1  # of the scanned hand
DISTANCE_MM = 1.5
TENSION = 0.05
DEPTH_MM = 3.0
SHAKE_MM, SHAKE_LENGTH_MM = 0.5, 1.5  # of the hand that leads the tool
REACH_MM = 6.0
STEP_MM = 0.25
MODULUS, AREA_DENSITY = 50.0, 1e-6  # mN/mm and kg/mm2: they do not matter for the shape at rest


@dataclass(frozen=True, slots=True, eq=False)
class HandCut:
    """A hand, the path of a tool over its back, and its cuts with and without refinement."""

    points: FloatArray
    triangles: IntArray
    tips: FloatArray
    refined: SurfaceCut
    rough: SurfaceCut


def chapter4_cut(seed: int = 0, *, distances: tuple[float, ...] = (3.0, 1.5, 0.75), frames: int = 8) -> Chapter:
    """Reproduce the cut of a hand with and without refinement, its groove, and its opening under tension, Figures 16 to 18.

    Parameters
    ----------
    seed : int
        Of the noise of the scan and of the shaking of the tool.
    distances : tuple of float
        Distances d that are compared, mm.
    frames : int
        States of the opening.
    """
    hand = cut_hand(seed)
    sections = (path_section(hand), distance_section(hand, distances), groove_section(hand, frames))
    settings: dict[str, Cell] = {"seed": seed, "edge of the scan, mm": EDGE_MM, "d, mm": DISTANCE_MM}
    return Chapter("ch4-cut", "Chapter 4.4: cutting a scanned surface", sections, settings)


def cut_hand(seed: int) -> HandCut:
    """Cut the back of a hand along a shaken path."""
    points, triangles = hand_surface(EDGE_MM, NOISE_MM, seed)
    tips = shaken_path(points, seed)
    refined, rough = (
        cut_surface(points, triangles, tips, DISTANCE_MM, reach_mm=REACH_MM, refined=refined) for refined in (True, False)
    )  # fmt: skip
    return HandCut(points, triangles, tips, refined, rough)


def shaken_path(points: FloatArray, seed: int) -> FloatArray:
    """Path (m, 3), mm, of a tip on the back of a hand, from the wrist to the knuckles."""
    along = np.arange(0.0, 1.0 + 1e-9, STEP_MM / 70.0)
    x, y = -16.0 + 30.0 * along**1.5, 8.0 + 62.0 * along
    rough = gaussian_filter1d(np.random.default_rng(seed).normal(size=(2, len(along))), SHAKE_LENGTH_MM / STEP_MM, axis=1)
    x, y = np.stack([x, y]) + SHAKE_MM * rough / rough.std(axis=1, keepdims=True)
    back = points[points[:, 2] > 0.0]
    return np.stack([x, y, LinearNDInterpolator(back[:, :2], back[:, 2])(x, y)], axis=1)


def path_section(hand: HandCut) -> Section:
    """Return the two cuts and how far they are from the path."""
    rows: list[tuple[Cell, ...]] = []
    paper = (
        "“appears delicately; the very small shakes … are captured and expressed faithfully in zigzags”",
        "“far different from the motion”",
    )
    for name, said, cut in (("with", paper[0], hand.refined), ("without", paper[1], hand.rough)):
        rows.append(
            (name, said, len(cut.triangles), cut.deviation_mm, cut.mean_deviation_mm, cut.length_mm, cut.deviation_mm <= 0.5 * DISTANCE_MM)
        )
    rows = [tuple("yes" if c is True else "no" if c is False else c for c in row) for row in rows]
    columns = ("refinement", "paper", "triangles, ours", "largest distance, mm", "mean distance, mm", "length, mm", "within d/2")
    area = abs(float(hand.refined.areas_mm2.sum()) / _area(hand.points, hand.triangles) - 1.0)
    table = Table(
        "Fig. 17", columns, tuple(rows),
        caption=f"Distance of the cut from the path of the tool; {len(hand.triangles)} triangles before, d = {DISTANCE_MM:g} mm.",
        note="The report prints figures and no numbers here; its scan of a hand is not published.",
    )  # fmt: skip
    text = (
        "The surface is a hand of our own, as a scanner would give it: noisy and open at the wrist. The tool moves over its "
        f"back, shaken by {SHAKE_MM:g} mm (standard deviation). Triangles at the tool are bisected along their longest edge until this is "
        "shorter than d; the cut goes on to the vertex closest to the direction of the tool. The report bounds the lengths of the edges, "
        "d/2 < l < d; ours bounds the distance from the path too, by d/2.",
        f"No triangle is removed: the area changes by {area:.1g} of itself.",
    )
    pictures = (
        Figure("Fig. 16", "The hand, and the cut on its back.", figures.whole(hand.points, hand.triangles, hand.refined), (8.0, 4.5)),
        Figure("Fig. 17", "Cut (red) and path of the tool (blue), with refinement (left) and without (right), seen from above.",
               figures.compared({"with refinement": hand.refined, "without refinement": hand.rough}, hand.tips), (9.0, 6.5)),
    )  # fmt: skip
    return Section("The path of the tool", text, (table,), pictures)


def distance_section(hand: HandCut, distances: tuple[float, ...]) -> Section:
    """Return what the distance d costs, and the edges of the triangles at the cut."""
    rows: list[tuple[Cell, ...]] = []
    for distance in distances:
        cut, step = timed_cut(hand, distance)
        edges = np.linalg.norm(cut.cut_edges[:, 1] - cut.cut_edges[:, 0], axis=1)
        longest = _longest_edges(cut)
        within = float(((longest > 0.5 * distance) & (longest < distance)).mean()) if len(longest) else None
        rows.append((
            distance, len(cut.triangles), cut.deviation_mm / distance, cut.mean_deviation_mm / distance, float(edges.max()) / distance,
            None if within is None else 100.0 * within, 1e6 * float(np.median(step)), 1e6 * float(np.percentile(step, 99.0)),
        ))  # fmt: skip
    columns = (
        "d, mm", "triangles", "largest distance / d", "mean distance / d", "longest cut edge / d", "longest edges in (d/2, d), %",
        "step, median, µs", "step, 99 %, µs",
    )  # fmt: skip
    table = Table(
        "d", columns, tuple(rows), caption=f"Cuts for different distances d, and processor times; {len(hand.triangles)} triangles before.",
        note=f"A step is a movement of the tool by {STEP_MM:g} mm: search, refinement, separation, update of masses and springs.",
    )  # fmt: skip
    text = (
        "The report asks for triangles at the cut whose longest edges l satisfy d/2 < l < d. Bisection stops as soon as l < d; only where "
        "no edge leads on along the path ours bisects further. An update at haptic rates leaves 1000 µs for a step.",
    )
    return Section("The distance d", text, (table,))


def timed_cut(hand: HandCut, distance: float) -> tuple[SurfaceCut, FloatArray]:
    """Cut with springs that are kept up to date; returns the cut and the processor time of the movements, s."""
    springs = CutSprings(
        SurfaceCutter(hand.points, hand.triangles, distance, reach_mm=REACH_MM), membrane_modulus=MODULUS, area_density=AREA_DENSITY
    )
    spent = []
    for tip in hand.tips:
        began = time.thread_time()
        springs.move(tip)
        spent.append(time.thread_time() - began)
    return springs.cutter.result(), np.array(spent[1:])


def groove_section(hand: HandCut, frames: int) -> Section:
    """Return the groove and the opening of the cut under tension."""
    cut = hand.refined
    made = groove(cut, DEPTH_MM)
    states = list(opening(cut, TENSION, frames=frames))
    copies = np.flatnonzero(cut.source != np.arange(len(cut.points)))
    widest = [float(np.linalg.norm(u[copies] - u[cut.roots[copies]], axis=1).max()) for u in states]
    table = Table(
        "Fig. 18", ("quantity", "ours"),
        (
            ("depth of the groove, mm", DEPTH_MM), ("length of the cut, mm", cut.length_mm), ("walls, triangles", len(made.triangles)),
            ("walls, mm²", made.area_mm2), ("twice depth times length, mm²", 2.0 * DEPTH_MM * cut.length_mm),
            ("tension, %", 100.0 * TENSION), ("widest opening, half of the cut, mm", widest[len(widest) // 2]),
            ("widest opening, mm", widest[-1]),
        ),
        caption="The groove, and how far the cut opens.",
    )  # fmt: skip
    text = (
        "Walls go from both lips of the cut down to floor points, here a stated depth below the surface. Under tension the springs on the "
        "edges of the triangles, weighted by areas, open the cut behind the tool; the skin slides on what is beneath.",
    )
    figure = Figure(
        "Fig. 18",
        "Groove of the cut, opened by tension (red: walls).",
        figures.opened_groove(cut, made, _moved(made, states[-1])),
        (8.0, 5.0),
    )
    return Section("Groove and tension", text, (table,), (figure,))


def _moved(made: Groove, displacement: FloatArray) -> FloatArray:
    """Points of surface and floor with the surface displaced."""
    return np.concatenate([made.points[: len(displacement)] + displacement, made.points[len(displacement) :]])


def _longest_edges(cut: SurfaceCut) -> FloatArray:
    """Longest edges (k,) of the triangles that were bisected and touch the cut, mm."""
    at = np.isin(cut.triangles, cut.lips).any(axis=1)
    bisected = np.bincount(cut.parents, minlength=int(cut.parents.max()) + 1)[cut.parents] > 1
    corners = cut.points[cut.triangles[at & bisected]]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0))


def _area(points: FloatArray, triangles: IntArray) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
