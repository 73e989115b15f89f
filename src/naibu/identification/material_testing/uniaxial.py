"""Uniaxial material tests: Young's modulus from compression tests, Poisson's ratio from strains or from markers inside.

A compression test begins with slack (plates not yet in contact, faces that are not flat), its curve is nonlinear because the strain is
finite (:cite:p:`treloar1975`, chapter 5), and plates that constrain the faces make the specimen appear stiffer (:cite:p:`gent1959`). A
ratio of strains is Poisson's ratio at small strain only: an incompressible body shows 0.62 at 25 % compression, while logarithmic strains
(:cite:p:`hencky1928`) give 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError

Curve = Literal["neo_hookean", "linear"]
Ends = Literal["lubricated", "bonded"]
PoissonDefinition = Literal["hencky", "engineering", "volume_ratio", "neo_hookean"]
CONTACT_FORCE = 0.02  # of the largest force: below it the plates are taken not to touch, as a first guess
_ROUNDS = 50


@dataclass(frozen=True, slots=True)
class Specimen:
    """A prism or cylinder between two plates.

    Attributes
    ----------
    area : float
        Cross-section, mm2.
    perimeter : float
        Of the cross-section, mm.
    height : float
        Distance of the loaded faces in the reference configuration, mm.
    """

    area: float
    perimeter: float
    height: float

    def __post_init__(self) -> None:
        for name, value, unit in (("area", self.area, "mm2"), ("perimeter", self.perimeter, "mm"), ("height", self.height, "mm")):
            if not 0.0 < value < np.inf:
                raise InputError(f"the {name} of a specimen must be a positive number, not {value:g} {unit}; measure the specimen")

    @classmethod
    def cylinder(cls, diameter: float, height: float) -> Specimen:
        """Return a cylinder of `diameter` and `height`, mm."""
        return cls(np.pi * diameter**2 / 4.0 if diameter > 0.0 else diameter, np.pi * diameter, height)

    @classmethod
    def block(cls, width: float, depth: float, height: float) -> Specimen:
        """Return a block of `width`, `depth` and `height`, mm."""
        return cls(width * depth if min(width, depth) > 0.0 else min(width, depth), 2.0 * (width + depth), height)

    @property
    def shape_factor(self) -> float:
        """One loaded area over the area of the free sides."""
        return self.area / (self.perimeter * self.height)

    @property
    def bonded_stiffening(self) -> float:
        """Apparent over true Young's modulus where both faces are constrained, ``1 + 2 S^2`` with the shape factor S.

        Gent and Lindley 1959: incompressible, small strain, circular or nearly square cross-section. Computed cylinders with S from 0.2 to
        0.6 are another 6 to 7 % stiffer.
        """
        return 1.0 + 2.0 * self.shape_factor**2


@dataclass(frozen=True, slots=True)
class CompressionTest:
    """Result of a compression test.

    Attributes
    ----------
    young_modulus, standard_error : float
        At small strain, kPa.
    interval : tuple of float
        Confidence interval of Young's modulus, kPa.
    apparent_modulus : float
        Young's modulus without the correction for constrained faces, kPa.
    slack, slack_standard_error : float
        Displacement at which the fitted curve starts, mm; 0 where no slack was asked for.
    strain_range : tuple of float
        Smallest and largest compressive strain of the readings used.
    used : ndarray, shape (n,), bool
        Readings that were used.
    residual_sd : float
        Standard deviation of the readings used about the curve, mN.
    autocorrelation : float
        Of neighbouring residuals, in the order of displacement; the standard errors are enlarged for it.
    """

    young_modulus: float
    standard_error: float
    interval: tuple[float, float]
    apparent_modulus: float
    slack: float
    slack_standard_error: float
    strain_range: tuple[float, float]
    used: BoolArray
    residual_sd: float
    autocorrelation: float


def compression_test(
    displacement: ArrayLike,
    force: ArrayLike,
    specimen: Specimen,
    *,
    curve: Curve = "neo_hookean",
    slack: bool = True,
    strain_range: tuple[float, float] = (0.02, 0.1),
    ends: Ends = "lubricated",
    relative_area_sd: float = 0.0,
    relative_height_sd: float = 0.0,
    confidence: float = 0.95,
) -> CompressionTest:
    """Estimate Young's modulus from the readings of a compression test (:cite:p:`hirai2008`, Table 3.4).

    Fitted is ``F = A E g((d - d0) / H)``: with ``curve="linear"`` g(e) = e, with ``"neo_hookean"`` the nominal stress of an incompressible
    solid, g(e) = ((1 - e)^-2 - (1 - e)) / 3 (:cite:p:`treloar1975`). The slack d0 takes up plates that do not touch yet and the toe of
    faces that are not flat: readings outside `strain_range`, counted from d0, are left out, and the curve is extended to zero force.

    Parameters
    ----------
    displacement : array_like, shape (n,)
        Approach of the plates, mm, from any zero (from first contact where `slack` is False); of the loading only.
    force : array_like, shape (n,)
        Compressive force, mN, positive.
    specimen : Specimen
        Measures in the reference configuration.
    curve : {"neo_hookean", "linear"}
        Shape of the curve; the linear one underestimates its bending and overestimates the modulus at large strain.
    slack : bool
        Whether to estimate d0; else it is 0.
    strain_range : tuple of float
        Compressive strains of the readings to use.
    ends : {"lubricated", "bonded"}
        Whether the faces slide freely, or stick to the plates: then the modulus is divided by `Specimen.bonded_stiffening`.
    relative_area_sd, relative_height_sd : float
        Relative standard deviations of the specimen's measures, added to the standard error.
    confidence : float
        Of the interval.

    Raises
    ------
    InputError
        Readings that are not finite or do not pair, a range or option that does not exist, too few readings in the range, or a force
        that does not grow.
    """
    d, f, order = _readings(displacement, force)
    _check_options(curve, ends, strain_range, confidence, relative_area_sd, relative_height_sd)
    start = _first_contact(d, f) if slack else 0.0
    used = np.zeros(len(d), dtype=bool)
    for _ in range(_ROUNDS):
        strain = (d - start) / specimen.height
        chosen = (strain >= strain_range[0]) & (strain <= strain_range[1])
        if chosen.sum() < 4:
            raise InputError(
                f"{int(chosen.sum())} readings lie between strains {strain_range[0]:g} and {strain_range[1]:g} (contact at {start:.3g} mm, "
                f"height {specimen.height:g} mm); at least 4 are needed: widen strain_range or read more often"
            )
        if (chosen == used).all():
            break
        used = chosen
        modulus, start, covariance, residual = _fit(d[used], f[used], specimen, curve, start, slack)
    if not modulus > 0.0:
        raise InputError(f"the force does not grow with the displacement (modulus {modulus:.3g} kPa); count compressive force as positive")
    correlation = _autocorrelation(residual)
    covariance = covariance * (1.0 + correlation) / (1.0 - correlation)
    factor = specimen.bonded_stiffening if ends == "bonded" else 1.0
    relative = np.sqrt(covariance[0, 0] / modulus**2 + relative_area_sd**2 + relative_height_sd**2)
    freedom = len(residual) - 1 - int(slack)
    value, error = modulus / factor, float(relative * modulus / factor)
    half = float(stdtrit(freedom, 0.5 + 0.5 * confidence)) * error
    strain = (d[used] - start) / specimen.height
    given = np.zeros(len(d), dtype=bool)
    given[order[used]] = True
    return CompressionTest(
        value, error, (value - half, value + half), modulus, start, float(np.sqrt(covariance[1, 1])) if slack else 0.0,
        (float(strain.min()), float(strain.max())), given, float(np.sqrt(residual @ residual / freedom)), correlation,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class SpecimenMean:
    """Mean of the moduli of several specimens of one material, kPa.

    Attributes
    ----------
    mean, standard_deviation, standard_error : float
        The mean, the SD between specimens, and the uncertainty of the mean.
    interval : tuple of float
        Confidence interval of the mean (Student's t).
    """

    mean: float
    standard_deviation: float
    standard_error: float
    interval: tuple[float, float]


def specimen_mean(moduli: ArrayLike, *, confidence: float = 0.95) -> SpecimenMean:
    """Average the moduli (k,) of several specimens as in Table 3.4 of :cite:t:`hirai2008`, with the uncertainty from their SD.

    Raises
    ------
    InputError
        Fewer than two moduli, or one that is not a positive number.
    """
    e = np.asarray(moduli, dtype=float)
    if e.ndim != 1 or len(e) < 2 or not (np.isfinite(e) & (e > 0.0)).all():
        raise InputError(f"a mean over specimens needs at least two positive moduli, kPa, not {e.tolist()}")
    _check_confidence(confidence)
    mean, sd = float(e.mean()), float(e.std(ddof=1))
    error = sd / float(np.sqrt(len(e)))
    half = float(stdtrit(len(e) - 1, 0.5 + 0.5 * confidence)) * error
    return SpecimenMean(mean, sd, error, (mean - half, mean + half))


@dataclass(frozen=True, slots=True)
class PoissonRatio:
    """Poisson's ratio, as `definition` has it.

    Attributes
    ----------
    value, standard_error : float
        Poisson's ratio.
    interval : tuple of float
        Its confidence interval; it may reach beyond 0.5, which no solid does.
    volume_ratio, volume_ratio_standard_error : float
        Deformed over free volume, which the strains imply.
    definition : str
        How it was computed.
    """

    value: float
    standard_error: float
    interval: tuple[float, float]
    volume_ratio: float
    volume_ratio_standard_error: float
    definition: PoissonDefinition


def poisson_ratio(
    longitudinal_strain: float,
    transversal_strain: float,
    *,
    longitudinal_sd: float = 0.0,
    transversal_sd: float = 0.0,
    correlation: float = 0.0,
    definition: PoissonDefinition = "hencky",
    confidence: float = 0.95,
) -> PoissonRatio:
    """Compute Poisson's ratio from the strains of a bar that is free to widen (:cite:p:`hirai2008`, Table 3.5).

    With the stretches l = 1 + longitudinal and t = 1 + transversal strain and the volume ratio J = l t^2, the definitions are

    * ``"engineering"``: -(t - 1) / (l - 1), only for small strain,
    * ``"hencky"``: -ln t / ln l = (1 - ln J / ln l) / 2, 0.5 where the volume is kept, at any strain (:cite:p:`hencky1928`),
    * ``"volume_ratio"``: (1 - (J - 1) / (l - 1)) / 2, the small-strain relation between dilatation and strain,
    * ``"neo_hookean"``: lambda / (2 lambda + 2 mu) of the law ``neo_hookean``, whose free sides demand mu (t^2 - 1) + lambda ln J = 0.

    Parameters
    ----------
    longitudinal_strain, transversal_strain : float
        Change of length over length in the reference configuration; negative where shortened.
    longitudinal_sd, transversal_sd, correlation : float
        Standard deviations of the strains, and the correlation of their errors.
    definition : str
        One of the above.
    confidence : float
        Of the interval.

    Raises
    ------
    InputError
        A strain of -1 or less, no longitudinal strain, an unknown definition, or a negative standard deviation.
    """
    if definition not in get_args(PoissonDefinition):
        raise InputError(f"definition {definition!r} of Poisson's ratio is not known; use one of {', '.join(get_args(PoissonDefinition))}")
    _check_confidence(confidence)
    if not (longitudinal_strain > -1.0 and transversal_strain > -1.0 and longitudinal_strain + transversal_strain < np.inf):
        raise InputError(f"strains must be finite and above -1, not {longitudinal_strain:g} and {transversal_strain:g}")
    if longitudinal_strain == 0.0:
        raise InputError("the longitudinal strain is 0: load the specimen before measuring Poisson's ratio")
    if not (longitudinal_sd >= 0.0 and transversal_sd >= 0.0 and abs(correlation) <= 1.0):
        raise InputError(
            "standard deviations of strains must be >= 0 and their correlation within [-1, 1], "
            f"not {longitudinal_sd:g}, {transversal_sd:g} and {correlation:g}"
        )
    stretch, widening = 1.0 + longitudinal_strain, 1.0 + transversal_strain
    value, gradient = _poisson_value(stretch, widening, definition)
    cross = correlation * longitudinal_sd * transversal_sd
    covariance = np.array([[longitudinal_sd**2, cross], [cross, transversal_sd**2]])
    error = float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
    volume = stretch * widening**2
    slope = np.array([volume / stretch, 2.0 * volume / widening])
    volume_error = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    half = float(ndtri(0.5 + 0.5 * confidence)) * error
    return PoissonRatio(value, error, (value - half, value + half), volume, volume_error, definition)


def _poisson_value(stretch: float, widening: float, definition: PoissonDefinition) -> tuple[float, FloatArray]:
    """Poisson's ratio and its derivatives (2,) with respect to the longitudinal and the transversal stretch."""
    if definition == "engineering":
        value = -(widening - 1.0) / (stretch - 1.0)
        return value, np.array([-value, -1.0]) / (stretch - 1.0)
    if definition == "hencky":
        value = -float(np.log(widening) / np.log(stretch))
        return value, np.array([-value / stretch, -1.0 / widening]) / np.log(stretch)
    if definition == "volume_ratio":
        dilatation = stretch * widening**2 - 1.0
        strain = stretch - 1.0
        by_stretch = -0.5 * (widening**2 / strain - dilatation / strain**2)
        return 0.5 * (1.0 - dilatation / strain), np.array([by_stretch, -stretch * widening / strain])
    # nu = r / (2 (1 + r)) with r = lambda / mu = a / b; written so that b = ln J = 0 gives 0.5
    a, b = 1.0 - widening**2, float(np.log(stretch * widening**2))
    da, db = np.array([0.0, -2.0 * widening]), np.array([1.0 / stretch, 2.0 / widening])
    total = a + b
    if total == 0.0:
        raise InputError(f"stretches {stretch:g} and {widening:g} fit no neo-Hookean solid that is free to widen; use definition='hencky'")
    return 0.5 * a / total, 0.5 * (da * total - a * (da + db)) / total**2


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence must lie between 0 and 1, not {confidence:g}; 0.95 is usual")


def _check_options(curve: str, ends: str, strain_range: tuple[float, float], confidence: float, *relative_sd: float) -> None:
    if curve not in get_args(Curve):
        raise InputError(f"curve {curve!r} is not known; use one of {', '.join(get_args(Curve))}")
    if ends not in get_args(Ends):
        raise InputError(f"ends {ends!r} are not known; use one of {', '.join(get_args(Ends))}")
    if not 0.0 <= strain_range[0] < strain_range[1] < 1.0:
        raise InputError(f"strain_range must rise within [0, 1), not {strain_range[0]:g} to {strain_range[1]:g}")
    if not all(0.0 <= sd < np.inf for sd in relative_sd):
        raise InputError(f"relative standard deviations of the specimen's measures must be >= 0, not {relative_sd}")
    _check_confidence(confidence)


def _readings(displacement: ArrayLike, force: ArrayLike) -> tuple[FloatArray, FloatArray, IntArray]:
    """Displacement and force in the order of displacement, and that order."""
    d, f = np.array(displacement, dtype=float), np.array(force, dtype=float)
    if d.ndim != 1 or d.shape != f.shape:
        raise InputError(f"displacement and force of a compression test must have one shape (n,), not {d.shape} and {f.shape}")
    bad = np.flatnonzero(~(np.isfinite(d) & np.isfinite(f)))
    if len(bad):
        raise InputError(
            f"reading {bad[0]} of the compression test is {d[bad[0]]:g} mm, {f[bad[0]]:g} mN; leave out readings without value"
        )
    if len(d) < 4:
        raise InputError(f"a compression test needs at least 4 readings, not {len(d)}")
    order = np.argsort(d, kind="stable")
    return d[order], f[order], order


def _first_contact(d: FloatArray, f: FloatArray) -> float:
    if not f.max() > 0.0:
        raise InputError(f"the largest force of the compression test is {f.max():g} mN; count compressive force as positive")
    quiet = np.flatnonzero(f[: int(np.argmax(f)) + 1] <= CONTACT_FORCE * f.max())
    return float(d[quiet[-1]] if len(quiet) else d[0])


def _curve(strain: FloatArray, curve: Curve) -> tuple[FloatArray, FloatArray]:
    """Nominal stress over Young's modulus at compressive strains, and its slope."""
    if curve == "linear":
        return strain, np.ones_like(strain)
    stretch = 1.0 - strain
    return (stretch**-2 - stretch) / 3.0, (2.0 * stretch**-3 + 1.0) / 3.0


def _fit(
    d: FloatArray, f: FloatArray, specimen: Specimen, curve: Curve, start: float, slack: bool
) -> tuple[float, float, FloatArray, FloatArray]:
    """Modulus kPa, slack mm, their covariance (2, 2) and the residuals mN of the least-squares curve (Gauss-Newton)."""
    modulus = 0.0
    for _ in range(_ROUNDS):
        g, slope = _curve(np.minimum((d - start) / specimen.height, 0.99), curve)
        if not slack or modulus == 0.0:
            modulus = float(f @ g / (g @ g) / specimen.area)
        residual = f - specimen.area * modulus * g
        columns = [specimen.area * g, -specimen.area * modulus * slope / specimen.height][: 1 + int(slack)]
        design = np.stack(columns, axis=1)
        step = np.linalg.lstsq(design, residual, rcond=None)[0]
        modulus += float(step[0])
        if not slack:
            break
        moved = float(np.clip(step[1], -0.2 * specimen.height, 0.2 * specimen.height))
        start += moved
        if abs(moved) <= 1e-12 * specimen.height:
            break
    g, slope = _curve(np.minimum((d - start) / specimen.height, 0.99), curve)
    residual = f - specimen.area * modulus * g
    covariance = np.zeros((2, 2))
    size = design.shape[1]
    covariance[:size, :size] = np.linalg.pinv(design.T @ design) * float(residual @ residual) / (len(d) - size)
    return modulus, start, covariance, residual


def _autocorrelation(residual: FloatArray) -> float:
    """Correlation of neighbouring residuals, not below 0 and not above 0.95."""
    total = float(residual @ residual)
    return float(np.clip(residual[1:] @ residual[:-1] / total, 0.0, 0.95)) if total > 0.0 else 0.0
