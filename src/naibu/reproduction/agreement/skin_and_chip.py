"""Chapters 5 and 6: skin, mammography, the sensing chip and the fingertip."""

from __future__ import annotations

from naibu.reproduction.agreement.read_tables import Tables, compared, verdict
from naibu.reproduction.chapter5.mammography import CURVE, OBSERVED, SCANNED
from naibu.reproduction.chapter5.scanned_breasts import CONSTRAINED, EQUILIBRIUM, IN_SCAN
from naibu.viewer.chapters.comparisons import Comparison


def of_chapter5(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 5 says, beside ours."""
    same, layers = "Figure 5.8, numbers", "Figure 5.9, numbers"
    constants = [tables.number(same, (f"C1 = {c} Pa s", "converged"), "fall, time constant, s") for c in (30, 80)]
    residuals = [tables.number(same, (f"C1 = {c} Pa s", "converged"), "residual at 3 s, mm") for c in (30, 80)]
    study = "What the time constants depend on"
    short, long = (tables.number(study, ("duration, s", value), "fall, time constant, s") for value in ("0.1", "4"))
    alone = tables.number(same, ("C1 = 30 Pa s", "converged"), "rise 10-90 %, s")
    quick, slow = (tables.number(layers, (name, "converged"), "rise 10-90 %, s") for name in _LAYERS)
    grid, converged = (tables.number(same, ("C1 = 30 Pa s", mesh), "at release, mm") for mesh in ("printed", "converged"))
    return (
        Comparison(
            "Rise and fall are faster with C1 = 30 than with 80 Pa s (Fig. 5.8)",
            "in curves",
            f"time constants {1e3 * constants[0]:.3g} and {1e3 * constants[1]:.3g} ms",
            verdict(constants[0] < constants[1]),
        ),
        Comparison(
            "The residual displacement depends on the dashpot in series only (Fig. 5.8)",
            "in curves",
            f"{residuals[0]:.3g} and {residuals[1]:.3g} mm with either C1",
            verdict(abs(residuals[0] / residuals[1] - 1.0) < 0.02),
        ),
        Comparison(
            "Time constants do not depend on viscoelasticity, but on how long the force acts (5.5)",
            "concluded",
            f"{constants[1] / constants[0]:.2g} times as long with C1 = 80 for 30 Pa s; {long / short:.3g} times as long with 4 for 0.1 s",
            verdict(constants[1] / constants[0] < 1.1),
            "It contradicts Fig. 5.8: in one material both constants are C1 / E. What depends on the duration is the time from 10 to 90 %.",
        ),
        Comparison(
            "A soft lower layer makes the rise slow after its fast beginning (Fig. 5.9)",
            "in curves",
            f"from 10 to 90 % in {quick:.2g} to {slow:.2g} s, for {alone:.2g} s of one material",
            verdict(quick > 0.1),
        ),
        Comparison(
            "Indentation at release (Fig. 5.8)",
            "curves without a scale that can be read",
            f"{grid:.2g} mm on the printed grid, {converged:.2g} mm converged, in skin of 1 mm",
            "cannot be compared",
            "With the printed force, modulus and height the strains are not small, which the linear model supposes; and the printed "
            "triangles lock at a Poisson ratio of 0.49.",
        ),
        *_mammography(tables),
    )


def _mammography(tables: Tables) -> tuple[Comparison, ...]:
    def seen(quantity: str) -> tuple[float, float]:
        first, second = (tables.number(OBSERVED, (quantity, where), "measured") for where in _WHERE[quantity])
        return first, second

    outward, rise, area, volume = (seen(quantity) for quantity in _WHERE)
    names = (IN_SCAN, EQUILIBRIUM, CONSTRAINED)
    places = [[tables.number(SCANNED, (name,), view) for view in ("CC, mm", "MLO, mm")] for name in names]
    scan, free, onto = (sum(both) / 2.0 for both in places)
    wide = [tables.number(SCANNED, (name,), "CC wider by, %") for name in ("true", EQUILIBRIUM)]
    curve = tables.number(CURVE, ("outlines, distances and angle",), "mean, mm")
    return (
        Comparison(
            "Cross-sections of the phantom bend outward, most half-way between the plates (section IV)",
            "seen",
            f"outward by {outward[0]:.2f} mm there, {outward[1]:.2f} mm near the plates",
            verdict(outward[0] > 1.2 * max(outward[1], 0.0)),
        ),
        Comparison(
            "Displacements in the mid-plane should be considered (section IV)",
            "seen",
            f"it rises by {rise[0]:.2f} mm",
            verdict(rise[0] > 1.0),
        ),
        Comparison(
            "Markers of a layer get denser where the plates press than beside them (Fig. 8b)",
            "seen",
            f"area less by {100.0 * (1.0 - area[0]):.1f} %, beside them {100.0 * (1.0 - area[1]):.1f} %",
            verdict(area[0] < area[1] < 1.0),
        ),
        Comparison(
            "Conservation of volume that is too strong removes from reality (section IV)",
            "concluded",
            f"volume {100.0 * volume[0]:.1f} and {100.0 * volume[1]:.1f} % of that at rest",
            verdict(min(volume) < 0.98),
            "The layer rises and arches: its markers come closer, and the volume between them stays.",
        ),
        Comparison(
            "A lesion of the scan appears nearest to its place by the equilibrium on the outlines, then by the equilibrium (Fig. 7)",
            "seen in one lesion",
            f"{onto:.1f} mm and {free:.1f} mm from there, {scan:.1f} mm where it is in the scan",
            verdict(onto < free < scan),
            "On virtual breasts, in both views; the paper has one lesion of one patient.",
        ),
        Comparison(
            "A simulated compression does not grow along the chest wall as the mammogram does (Fig. 5)",
            "seen in one patient",
            f"in CC by {wide[1]:.0f} %, virtual breasts by {wide[0]:.0f} %",
            "cannot be compared",
            "Both let the tissue slide along the chest wall; what that of a patient does, the paper does not measure.",
        ),
        Comparison(
            "Distance of a lesion to the curve in the other view",
            "7 mm on 50 patients; 2.2 mm with the patient's MR",
            f"no patients here; {curve:.2g} mm on virtual breasts, from outlines alone",
            "cannot be compared",
            "They are positioned better than patients.",
        ),
    )


_LAYERS = ("model 1, lower C1 = 500 Pa s", "model 3, lower C1 = 2000 Pa s")
_SHEETS, _PLATES = ("half-way between the plates", "near the plates"), ("between the plates", "beside them")
_WHERE = {
    "moves outward, mm": _SHEETS,
    "rises, mm": _SHEETS,
    "area of the lowest layer, over that at rest": _PLATES,
    "volume, over that at rest": _PLATES,
}


def of_chapter6(tables: Tables) -> tuple[Comparison, ...]:
    """Return what chapter 6 says, beside ours."""
    return *_chip(tables), *_fingertip(tables)


def _chip(tables: Tables) -> tuple[Comparison, ...]:
    force, moment = "F_z, mV/mN", "M_y, mV/(N µm)"
    whole = "finite elements, whole chip"
    both = tables.number("Table 6.1, strength", ("both together",), "largest nominal stress, GPa")
    borne = [tables.number("Fillets", ("20 µm",), name) for name in ("F_z borne, mN", "M_x or M_y borne, N µm")]
    chip = "The dimensions are not printed; those assumed give it by the closed forms, so that this tests the formulas alone."
    return (
        compared(
            "Sensitivity to F_z by the closed forms (Table 6.1)",
            _sensitivity(tables, force, "closed form"),
            "mV/mN",
            within=0.03,
            why=chip,
        ),
        compared(
            "Sensitivity to moments by the closed forms (Table 6.1)",
            _sensitivity(tables, moment, "closed form"),
            "mV/(N µm)",
            within=0.03,
            why=chip,
        ),
        compared("Sensitivity to F_z by finite elements of that chip", _sensitivity(tables, force, whole), "mV/mN", within=0.05),
        compared(
            "Sensitivity to moments by finite elements of that chip",
            _sensitivity(tables, moment, whole),
            "mV/(N µm)",
            within=0.05,
            differs="Frame and block yield where the resistors of the moments lie, which the closed forms neglect.",
        ),
        Comparison(
            "Equations (8), (11), (18) and (20) to (22)",
            "as printed",
            "corrected",
            "differs",
            "A factor of a half, an I for an L, and a sign: see the table of misprints. All count for less than 1 % of the stress.",
        ),
        Comparison(
            "Strength: 5000 mN and 800 N µm (Table 6.1)",
            "5000 mN; 800 N µm",
            f"together {both:.2g} GPa; with fillets of 20 µm {borne[0]:.0f} mN or {borne[1]:.0f} N µm are borne",
            "differs",
            "At an assumed strength of 2 GPa, either limit holds for the nominal stress alone: not both, and not in the corners.",
        ),
    )


def _fingertip(tables: Tables) -> tuple[Comparison, ...]:
    tests, forty, turned = "Figures 6.9 and 6.11 at 3 N", "Papers, 40 mm fingertip to 60 N", "Geometry, contact and law turned off in turn"
    flat, tilted = ([tables.number(tests, (tilt,), name) for name in ("F_z, V", "M_x, V", "M_y, V")] for tilt in (0.0, 30.0))
    steep = tables.rows(forty, "θ, degrees", "F_z, V", "M_x, V", "M_y, V")
    bend = tables.number(turned, (str(tables.rows(turned, "what counts")[0][0]),), "of M_y over F_x, %")
    return (
        Comparison(
            "Fingertip: M_y grows with θ at φ = 90 degrees, M_x does not (Fig. 6.11)",
            "in curves",
            f"at 3 N and 30 degrees {tilted[2]:.3g} and {tilted[1]:.2g} V; upright {flat[2]:.2g} V",
            verdict(abs(tilted[2]) > 10.0 * max(abs(tilted[1]), abs(flat[2]))),
            "M_x of an aligned jig; an error of 1 to 2 degrees lifts it.",
        ),
        Comparison(
            "Fingertip: F_z is constant over θ (Fig. 6.9)",
            "in curves",
            f"falls by {100 * (1 - tilted[0] / flat[0]):.0f} % to 30 degrees",
            verdict(abs(tilted[0] / flat[0] - 1.0) < 0.05),
            "The force along the base's normal alone falls by 13 %; that a central load gives the same at every angle does not follow.",
        ),
        Comparison(
            "40 mm fingertip: F_z is larger at 20 degrees than at 0 (papers)",
            "in curves",
            f"{steep[-1][1]:.3g} for {steep[0][1]:.3g} V",
            verdict(float(str(steep[-1][1])) > float(str(steep[0][1]))),
            "Ours presses towards the centre; theirs may have pressed towards the base.",
        ),
        Comparison(
            "Slight S in M_y over M_x, by nonlinear geometry and material (Fig. 6.12)",
            "in a curve",
            f"bends by {bend:.2g} %, without an S",
            "differs",
            "Geometry, contact and law bend the loads, but alike: their ratio stays nearly straight. An offset or the jig could make an S.",
        ),
    )


def _sensitivity(tables: Tables, bridge: str, model: str) -> tuple[float, float]:
    return tables.number("Sensitivity", (bridge,), "paper"), tables.number("Sensitivity", (bridge,), model)
