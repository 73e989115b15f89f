"""Chapter 3: moduli of gels from inner deformation."""

from __future__ import annotations

from naibu.reproduction.agreement.read_tables import Tables, alike, compared, verdict
from naibu.viewer.chapters.comparisons import Comparison


def of_chapter3(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 3 says, beside ours."""
    return *_square(tables), *_cubes(tables), *_gels(tables)


def _square(tables: Tables) -> tuple[Comparison, ...]:
    counts = [
        (tables.number("Table 3.1", (name,), "paper"), tables.number("Table 3.1", (name,), "ours"))
        for name in ("unknown moduli", "equations, one trial", "equations, two trials")
    ]
    pushes = "Table 2 (2007)"
    row = ("(0, 50)", "(50, 50)")
    noise = tables.number(pushes, row, "noise that explains lambda13, % of the push")
    shown = [", ".join(f"{c[k]:.0f}" for c in counts) for k in (0, 1)]
    return (
        Comparison(
            "Unknowns and equations of the square, one and two trials (Table 3.1)",
            shown[0],
            shown[1],
            verdict(all(a == b for a, b in counts)),
        ),
        compared(
            "λ of triangle 13 after the pushes of 50 mm, exact displacements (Table 2 of 2007; true 10.74)",
            [tables.number(pushes, row, f"lambda13, kPa, {who}") for who in ("paper", "ours")],
            "kPa",
            within=0.05,
            differs=f"Ours is the true one. Rounding of {noise:.2g} % of the push explains the printed one: the last "
            "triangles collect the errors of all before them.",
        ),
    )


def _cubes(tables: Tables) -> tuple[Comparison, ...]:
    uniform = [tables.number("Table 3.2", (way,), "E mean, Pa") for way in ("paper, symmetric", "ours, symmetric")]
    layers = [[tables.number("Table 3.3", (f"layer {k}, {way}",), "E mean, Pa") for way in ("paper", "ours, symmetric")] for k in (1, 2)]
    ratio = [tables.number("Table 3.3", (f"layer 2, {way}",), "nu mean") for way in ("true", "paper", "ours, symmetric")]
    return (
        compared(
            "Uniform cube, mean Young's modulus (Table 3.2; true 500)",
            uniform,
            "Pa",
            within=0.05,
            why="Moduli of single tetrahedra scatter by half in both; only their mean is right.",
        ),
        compared("Two layers, mean Young's modulus of layer 1 (Table 3.3; true 250)", layers[0], "Pa", within=0.1),
        compared("Two layers, mean Young's modulus of layer 2 (Table 3.3; true 500)", layers[1], "Pa", within=0.1),
        compared(
            f"Two layers, mean Poisson's ratio of layer 2 (Table 3.3; true {ratio[0]:g})",
            ratio[1:],
            "",
            within=0.05,
            why="Minimum norm leaves the same error in both; the printed mean lies outside the printed range of its elements.",
        ),
    )


def _gels(tables: Tables) -> tuple[Comparison, ...]:
    known, low, high = 155.0, *_interval(tables)
    stiff = [tables.number("Table 3.7", (name,), "E, kPa") for name in ("compression test (Tables 3.4, 3.5)", "paper, Table 3.7")]
    ours = tables.number("Table 3.7", ("one pair, neo-hookean, weighted", "inner"), "E, kPa")
    nu = [
        tables.number("Table 3.7", ("paper, Table 3.7",), "nu"),
        tables.number("Table 3.7", ("one pair, neo-hookean, weighted", "inner"), "nu"),
    ]
    volume = [
        tables.number("Table 3.5", ("hardness 5", source), "volume ratio J")
        for source in ("report, Table 3.5", "markers, ct_two_material_2/deformed")
    ]
    test = [tables.number("Table 3.4", ("hardness 5", None), name) for name in ("mean, paper (kPa)", "mean, ours (kPa)")]
    spread = tables.cell("Table 3.4", ("hardness 5", None), "95 % interval (kPa)")
    norms = [float(str(e)) for method, e in tables.rows("Table 3.7", "method", "E, kPa") if "minimum norm" in str(method) and e is not None]
    return (
        compared(
            "Young's modulus of hardness 5 by compression, mean (Table 3.4)",
            test,
            "kPa",
            within=0.02,
            why=f"Of three cylinders that differ by a half: the 95 % interval is {spread} kPa.",
        ),
        Comparison(
            "Young's modulus of hardness 0 from inner deformation (Table 3.7)",
            f"{stiff[1]:.0f} kPa (compression: {stiff[0]:.0f})",
            f"{ours:.0f} kPa, 95 % interval {low:.0f} to {high:.0f}",
            verdict(low <= known <= high),
            f"Inner nodes, a neo-Hookean law and weights; the report's minimum norm gives {min(norms):.0f} to {max(norms):.0f} kPa.",
        ),
        compared(
            "Poisson's ratio of hardness 0 from inner deformation (Table 3.7)",
            nu,
            "",
            within=0.1,
            differs="The balance of forces hardly tells it; markers themselves show a gel that keeps its volume.",
        ),
        Comparison(
            "Volume that is left under compression, hardness 5: strains of Table 3.5, and markers",
            f"{volume[0]:.2f}",
            f"{volume[1]:.2f}",
            verdict(alike(volume[0], volume[1], within=0.05)),
            ""
            if alike(volume[0], volume[1], within=0.05)
            else "The printed strains would make a gel lose a sixth of its volume: they "
            "cannot be of the same place. The Poisson ratios of Table 3.5 follow from them.",
        ),
    )


def _interval(tables: Tables) -> tuple[float, float]:
    row = ("one pair, neo-hookean, weighted", "inner")
    modulus, sd = (tables.number("Table 3.7", row, name) for name in ("E, kPa", "SD of E, kPa"))
    return modulus - 1.96 * sd, modulus + 1.96 * sd
