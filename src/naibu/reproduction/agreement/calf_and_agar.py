"""Chapters 1 and 2: motion in images of a calf, and blocks of agar."""

from __future__ import annotations

from naibu.reproduction.agreement.read_tables import Tables, alike, compared, verdict
from naibu.viewer.chapters.comparisons import Comparison

_LOST = "The report's scans are lost; ours are of a virtual calf, whose tissue, noise and motion are others."


def of_chapter1(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 1 says, beside ours."""
    two, volumes, many, points = "Table 1.1", "Table 1.3", "500 points", "Table 1.2"
    tpa, rfm = (tables.number(two, (f"paper, {name}",), "matches") for name in ("TPA", "RFM"))
    ours, chen = (tables.number(two, (f"ours, {name}",), "matches") for name in ("direction", "chen"))
    rms = [tables.number(volumes, (way,), "RMS (1.29), intensity levels") for way in ("paper, this paper", "paper, RPFM")]
    found = [tables.number(volumes, (way,), "RMS (1.29), intensity levels") for way in ("ours, direction26", "ours, chen")]
    default, floor = (
        tables.number(volumes, (way,), "RMS (1.29), intensity levels") for way in ("ours, naibu's default", "true displacement")
    )
    shares = [tables.number(many, row, "good, %") for row in (("paper",), ("ours, direction26", "256 x 256 x 40"))]
    printed, follows = (tables.number(points, ("paper, TPA",), name) for name in ("printed RMSE, cm", "RMS, cm"))
    return (
        Comparison(
            "Matches of 200 and 240 points: the report's approach against Chen's (Table 1.1)",
            f"{tpa:.0f} against {rfm:.0f}",
            f"{ours:.0f} against {chen:.0f}",
            verdict(ours > 1.05 * chen),
            "" if ours > 1.05 * chen else "What helps is that neighbours agree on distances, which both share.",
        ),
        Comparison(
            "In volumes both approaches leave nearly the same intensity residual (Table 1.3)",
            f"{rms[0]:.2f} and {rms[1]:.2f} levels",
            f"{found[0]:.2f} and {found[1]:.2f} levels",
            verdict(alike(found[1], found[0], within=0.05)),
        ),
        Comparison(
            "Size of that residual (Table 1.3)",
            f"{rms[0]:.2f} levels",
            f"{found[0]:.2f} levels; {default:.2f} by volume correlation, {floor:.2f} with the true displacement",
            "cannot be compared",
            _LOST,
        ),
        compared(
            "Good ones among the matches of 500 points in a volume",
            shares,
            "%",
            within=0.1,
            differs="The report does not say how it judged; ours must lie within 2 mm of the truth. " + _LOST,
        ),
        compared(
            "Root mean square error of the ten check points, from the errors that are printed (Table 1.2)",
            (printed, follows),
            "cm",
            within=0.02,
            differs="A slip in print: 0.396 is the root of the mean of the errors, without squares.",
        ),
    )


def of_chapter2(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 2 says, beside ours."""
    squares, column = "Squares", "residual, ours, % of the indentation"
    left = [tables.number(squares, (f"{name} square",), column) for name in ("elastic", "viscoplastic", "rheological")]
    rows: list[Comparison] = [
        Comparison(
            "After release the elastic square recovers, the other two keep deformation (Figs 1 to 3)",
            "in pictures",
            f"{left[0]:.1f} %, {left[1]:.0f} % and {left[2]:.1f} % of the indentation are left",
            verdict(abs(left[0]) < 5.0 and min(left[1:]) > 50.0),
            "Sizes, depth and times are assumed; closed forms give the same.",
        )
    ]
    errors = "Errors against ultrasound"
    for axis, within in (("x", 0.25), ("y", 0.25)):
        paper = [tables.number(errors, (marker,), f"report {axis}, mm") for marker in (2, 3, 4)]
        ours = [tables.number(errors, (marker,), f"ours, trial 1, {axis}, mm") for marker in (2, 3, 4)]
        same = all(alike(p, o, within=within) for p, o in zip(paper, ours, strict=True))
        why = (
            "Boundary conditions and grid points are not described."
            if same
            else "Ours are smaller: boundary conditions and grid points are not described, and readings are to 0.5 mm."
        )
        shown = [", ".join(f"{value:.2g}" for value in values) + " mm" for values in (paper, ours)]
        what = f"Errors of the simulated markers 2, 3, 4 along {axis}, against ultrasound (trial 1)"
        rows.append(Comparison(what, shown[0], shown[1], verdict(same), why))
    poisson = tables.number("Agar", ("Poisson's ratio",), "trial1: estimate")
    interval = tables.cell("Agar", ("Poisson's ratio",), "trial1: 95 %")
    low, high = (float(end) for end in str(interval).split(" to "))
    rows.append(
        Comparison(
            "Poisson's ratio of the agar: assumed, and identified from the same markers",
            "0.35",
            f"{poisson:.2f}, 95 % interval {interval}",
            verdict(low <= 0.35 <= high),
            "The markers hardly tell it; gels are nearly incompressible, and the best estimate says so." if low <= 0.35 <= high else "",
        )
    )
    return tuple(rows)
