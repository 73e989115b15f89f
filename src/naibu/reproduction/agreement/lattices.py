"""Chapter 4: adaptive meshes, cutting, and lattices of dough."""

from __future__ import annotations

from naibu.reproduction.agreement.read_tables import Tables, alike, compared, verdict
from naibu.viewer.chapters.comparisons import Comparison

_COSTS = "Ours handles nodes and elements together, in padded blocks of eight, on a processor of today: octrees save less there."
_TWIN = "The report's dough, cameras and force sensors are not at hand: ours are of a virtual twin, without errors of registration."
_AS_GOOD = 1.1  # of sums of a joint set over those of sets of their own


def of_adaptive(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 4.2 says of adaptive meshes, beside ours."""
    rows = tables.rows("Table I", "model", "paper, nodes", "ours, nodes", "paper, tetrahedra", "ours, tetrahedra")
    fixed = [row for row in rows if row[0] != "adaptive"]
    adaptive = next(row for row in rows if row[0] == "adaptive")
    step, whole = (tables.number("Cost", ("adaptive",), name) for name in ("step, of the high resolution", "and adaptation, ms"))
    high, own = (tables.number("Cost", (name,), "under the force: step, ms") for name in ("high", "adaptive"))
    rest = tables.number("Fig. 12", ("refined, coarsened, refined",), "difference at rest")
    return (
        Comparison(
            "Nodes and tetrahedra of the low and the high resolution (Table I)",
            "; ".join(f"{r[1]}, {r[3]}" for r in fixed),
            "; ".join(f"{r[2]}, {r[4]}" for r in fixed),
            verdict(all(r[1] == r[2] and r[3] == r[4] for r in fixed)),
        ),
        compared(
            "Nodes of the adaptive mesh at release (Table I)",
            (float(str(adaptive[1])), float(str(adaptive[2]))),
            "",
            within=0.05,
            why="Force and size are not printed: the force that comes nearest is taken, so that this tests little.",
        ),
        Comparison(
            "The state at rest does not depend on the way the mesh was refined (Fig. 12)",
            "in a picture",
            f"differs by {rest:.1g} of the sag",
            verdict(rest < 1e-3),
        ),
        Comparison(
            "An adaptive step is cheaper than one of the high resolution",
            "in a diagram",
            f"{step:.2g} of its time; with adaptation {(own + whole) / high:.2g}",
            verdict(own + whole < 0.8 * high),
            "Implicit steps of so few springs cost no more than preparing a mesh for them.",
        ),
    )


def of_cutting(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 4.2 says of cutting, beside ours."""
    within = [tables.cell("Fig. 17", (way,), "within d/2") for way in ("with", "without")]
    far = [tables.number("Fig. 17", (way,), "largest distance, mm") for way in ("with", "without")]
    return (
        Comparison(
            "With refinement the cut follows the tool (Fig. 17)",
            "“appears delicately”",
            f"within {far[0]:.2g} mm, d / 2 being 0.75 mm",
            verdict(within[0] == "yes"),
        ),
        Comparison(
            "Without, it does not (Fig. 17)", "“far different from the motion”", f"up to {far[1]:.2g} mm away", verdict(within[1] == "no")
        ),
        Comparison(
            "Scan of a hand that is cut",
            "a laser scan",
            "a surface made for the purpose",
            "cannot be compared",
            "The scan is not published.",
        ),
    )


def of_lattice(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 4.3 says of calibrations by shape and by force, beside ours."""
    found: list[Comparison] = []
    for number, shape, force, which in (("Table 1 (ICAT 2007)", "a", "b", "first"), ("Table 2 (ICAT 2007)", "e", "f", "second")):
        sums = [[tables.number(number, ("sum", "total"), f"{who} ({k})") for k in (shape, force)] for who in ("paper", "ours")]
        found.append(
            Comparison(
                f"Pattern ({shape}), calibrated on shape, has the smaller sum of distances than ({force}), {which} load case",
                f"{sums[0][0]:.4g} against {sums[0][1]:.4g} cm",
                f"{sums[1][0]:.4g} against {sums[1][1]:.4g} cm",
                verdict((sums[0][0] < sums[0][1]) == (sums[1][0] < sums[1][1])),
                _TWIN,
            )
        )
    worst = [max(float(str(row[0])) for row in tables.rows("One set or two", f"joint / set for {what}")) for what in ("shape", "force")]
    found.append(
        Comparison(
            "Two sets of parameters are needed, one for shape and one for force",
            "concluded",
            f"one joint set: at most {worst[0]:.3g} times the distances of the set for shape, {worst[1]:.3g} times the other's forces",
            verdict(max(worst) > _AS_GOOD),
            "" if max(worst) > _AS_GOOD else "The report fitted shape or force alone; on the twin one set, fitted jointly, serves both.",
        )
    )
    size = [tables.number("Table 1 (ICAT 2007)", ("sum", "total"), f"{who} (a)") for who in ("paper", "ours")]
    found.append(Comparison("Size of that sum, pattern (a)", f"{size[0]:.4g} cm", f"{size[1]:.4g} cm", "cannot be compared", _TWIN))
    return tuple(found)


def of_cube(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 4.3 says of octrees that are calibrated, beside ours."""
    found = []
    for title in [t.title for s in tables.sections for t in s.tables if "ours, sum, m" in t.columns]:
        rows = [row for row in tables.rows(title, "time", "lattice", "paper, sum, m", "ours, sum, m") if row[0] == "sum"]
        worst = [max(float(str(row[k])) for row in rows) / float(str(rows[0][k])) for k in (2, 3)]
        found.append(
            Comparison(
                f"Octrees fit shapes nearly as well as the classic lattice ({title}): worst sum of distances over its own",
                f"{worst[0]:.2f}",
                f"{worst[1]:.2f}",
                verdict(max(worst) < 1.25),
                "" if max(worst) < 1.25 else _TWIN,
            )
        )
        found.append(
            Comparison(
                f"Sum of distances of the classic lattice ({title})",
                f"{rows[0][2]:.3g} m",
                f"{rows[0][3]:.3g} m",
                "cannot be compared",
                _TWIN,
            )
        )
    return tuple(found)


def of_octree(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 4.3 says of the sizes and costs of octrees, beside ours."""
    found = []
    contradicts = "The printed others contradict the report's own memory tables."
    for title, misprints in (("Table I: nodes", ""), ("Table II: elements", contradicts)):
        rows = [row for row in tables.rows(title, "nodes per edge", "lattice", "paper", "ours") if row[3] is not None]
        same = sum(row[2] == row[3] for row in rows)
        apart = "; ".join(f"{row[2]} and {row[3]}" for row in rows if row[2] != row[3])
        found.append(
            Comparison(
                f"Sizes of {len(rows)} lattices ({title})",
                f"{len(rows)} numbers",
                f"{same} are the same{f'; apart: {apart}' if apart else ''}",
                verdict(same == len(rows)),
                misprints if apart else "",
            )
        )
    for title, caption in _costs(tables):
        rows = [
            row for row in tables.rows(title, "lattice", "paper saves, %", "ours saves, %") if row[1] is not None and row[2] is not None
        ]
        paper, ours = ([float(str(row[k])) for row in rows] for k in (1, 2))
        if rows:
            same = all(alike(a, b, within=0.35) or abs(a - b) < 10.0 for a, b in zip(paper, ours, strict=True))
            found.append(
                Comparison(
                    f"What octrees save ({title}: {caption})",
                    f"{min(paper):.0f} to {max(paper):.0f} %",
                    f"{min(ours):.0f} to {max(ours):.0f} %",
                    verdict(same),
                    "" if same else _COSTS,
                )
            )
    return tuple(found)


def _costs(tables: Tables) -> list[tuple[str, str]]:
    every = [t for s in tables.sections for t in s.tables]
    return [(t.title, t.caption.rstrip(".")) for t in every if "paper saves, %" in t.columns and ":" not in t.title]
