"""Models of both views of a breast, and models drawn from their uncertainty: from two outlines, or from a scanned shape."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline
from naibu.applications.mammography.breast_shape import BreastShape
from naibu.applications.mammography.epipolar import DEFAULT_UNCERTAINTY, MammographicPair, Model, ModelUncertainty
from naibu.applications.mammography.geometric_model import DEFAULT_PARAMETERS, Compression, CompressionParameters, compressed
from naibu.applications.mammography.mechanical_model import MechanicalCompression, mechanically_compressed
from naibu.applications.mammography.mechanical_views import mechanical_views, onto_widths
from naibu.applications.mammography.two_views import LEAST_ANGLE, MOST_ANGLE, TwoViews, two_views
from naibu.core.arrays import require_count, require_within
from naibu.core.errors import InputError

_MOST_REFUSED = 0.5
_MOST_DRAWS = 10_000


def mammographic_pair(
    cc: BreastOutline,
    mlo: BreastOutline,
    thickness_mm: tuple[float, float],
    angle_deg: float,
    *,
    model: Model = "geometric",
    parameters: CompressionParameters = DEFAULT_PARAMETERS,
    uncertainty: ModelUncertainty = DEFAULT_UNCERTAINTY,
    draws: int = 100,
    seed: int = 0,
) -> MammographicPair:
    """Build a model of a breast from both views, and geometric models drawn from the uncertainty.

    Parameters
    ----------
    cc, mlo : BreastOutline
        Outlines.
    thickness_mm : (float, float)
        Distances of the plates in CC and MLO.
    angle_deg : float
        Positioner angle of MLO against CC.
    model : {"geometric", "mechanical"}
        Closed maps, or equilibrium of finite elements with the default `MechanicalParameters`.
    parameters : CompressionParameters
        What the views leave open in the geometric model.
    uncertainty : ModelUncertainty
        Its standard deviations.
    draws : int
        Number of drawn models, 20 to 10 000.
    seed : int
        Of the random numbers.

    Raises
    ------
    InputError
        What `two_views` refuses, another model, too few or too many draws, or more than half of the draws giving no breast.
    ConvergenceError
        No equilibrium was found.
    """
    _require(model, draws, seed)
    outlines = cc, mlo

    def built(pair: _Parameters, plates: tuple[float, float], angle: float) -> TwoViews:
        return two_views(*outlines, plates, angle, pair)

    centre = built((parameters, parameters), thickness_mm, angle_deg)
    nominal = centre if model == "geometric" else mechanical_views(cc, mlo, thickness_mm, angle_deg)
    return _with_draws(outlines, nominal, centre, built, (thickness_mm, angle_deg, parameters, uncertainty, draws, seed))


def pair_of_shape(
    shape: BreastShape,
    thickness_mm: tuple[float, float],
    angle_deg: float,
    *,
    outlines: tuple[BreastOutline, BreastOutline] | None = None,
    constrain_outlines: bool = False,
    model: Model = "geometric",
    parameters: CompressionParameters = DEFAULT_PARAMETERS,
    uncertainty: ModelUncertainty = DEFAULT_UNCERTAINTY,
    draws: int = 100,
    seed: int = 0,
) -> MammographicPair:
    """Build a model of both views of a breast whose unloaded shape is known from a scan, and geometric models drawn from the uncertainty.

    Parameters
    ----------
    shape : BreastShape
        The unloaded breast.
    thickness_mm, angle_deg, model, parameters, uncertainty, draws, seed
        As of `mammographic_pair`.
    outlines : (BreastOutline, BreastOutline), optional
        Of CC and MLO: the nipple of the model is put onto theirs. By default the outlines are those of the model.
    constrain_outlines : bool
        Whether the equilibria of the mechanical model are scaled and shifted along the chest wall onto the widths of the outlines.

    Raises
    ------
    InputError
        Plates that do not press the breast, a constraint without outlines or by the geometric model, or what `mammographic_pair` refuses.
    ConvergenceError
        No equilibrium was found.
    """
    _require(model, draws, seed)
    if constrain_outlines and (outlines is None or model != "mechanical"):
        raise InputError("constrain_outlines needs the outlines of both views, and model 'mechanical'")
    if not LEAST_ANGLE <= angle_deg <= MOST_ANGLE:
        raise InputError(
            f"angle_deg is {angle_deg:g}: must be between {LEAST_ANGLE:g} and {MOST_ANGLE:g}, the positioner angle of MLO against CC"
        )

    def built(pair: _Parameters, plates: tuple[float, float], angle: float) -> TwoViews:
        views = [compressed(shape, a, t, p) for a, t, p in zip((0.0, angle), plates, pair, strict=True)]
        return TwoViews(shape, *(_at_nipple(view, k, outlines) for k, view in enumerate(views)))

    centre = built((parameters, parameters), thickness_mm, angle_deg)
    nominal = centre
    if model == "mechanical":
        states = [mechanically_compressed(shape, a, t) for a, t in zip((0.0, angle_deg), thickness_mm, strict=True)]
        if outlines is not None and constrain_outlines:
            nominal = TwoViews(shape, *(onto_widths(state, outline) for state, outline in zip(states, outlines, strict=True)))
        else:
            nominal = TwoViews(shape, *(_at_nipple(_from_own_nipple(state), k, outlines) for k, state in enumerate(states)))
    shown = outlines or (
        breast_outline(nominal.cc.outline(), what="outline of CC by the model"),
        breast_outline(nominal.mlo.outline(), what="outline of MLO by the model"),
    )
    return _with_draws(shown, nominal, centre, built, (thickness_mm, angle_deg, parameters, uncertainty, draws, seed))


_Parameters = tuple[CompressionParameters, CompressionParameters]
_Settings = tuple[tuple[float, float], float, CompressionParameters, ModelUncertainty, int, int]
_Pressed = TypeVar("_Pressed", Compression, MechanicalCompression)


def _from_own_nipple(state: MechanicalCompression) -> MechanicalCompression:
    """Return an equilibrium whose positions along the chest wall count from where its nipple appears, as those of outlines do."""
    return replace(state, shift=state.shift - breast_outline(state.outline(), what="outline by the model").nipple_mm)


def _at_nipple(view: _Pressed, index: int, outlines: tuple[BreastOutline, BreastOutline] | None) -> _Pressed:
    """Return a view whose nipple is as far from the edge of the image as in its outline."""
    return view if outlines is None else replace(view, hidden_mm=float(view.outline()[:, 0].max()) - outlines[index].depth_mm)


def _require(model: str, draws: int, seed: int) -> None:
    if model not in ("geometric", "mechanical"):
        raise InputError(f"model is {model!r}: must be 'geometric' or 'mechanical'")
    require_count("draws", draws, 20)
    require_within("draws", draws, 20, _MOST_DRAWS)
    require_count("seed", seed, 0)


def _with_draws(
    outlines: tuple[BreastOutline, BreastOutline],
    nominal: TwoViews,
    centre: TwoViews,
    built: Callable[[_Parameters, tuple[float, float], float], TwoViews],
    settings: _Settings,
) -> MammographicPair:
    thickness_mm, angle_deg, parameters, uncertainty, draws, seed = settings
    random = np.random.default_rng(seed)
    drawn, refused = [], 0
    for pair, plates, angle in _draws(random, draws, parameters, uncertainty, thickness_mm, angle_deg):
        try:
            drawn.append(built(pair, plates, angle))
        except InputError:
            refused += 1
    if refused > _MOST_REFUSED * draws:
        raise InputError(
            f"{refused} of {draws} models drawn from the uncertainty give no breast: the outlines, thickness_mm and angle_deg hardly fit"
        )
    z = random.standard_normal((len(drawn), 4))
    z -= z.mean(axis=0)
    z = np.linalg.solve(np.linalg.cholesky(z.T @ z / len(z)), z.T).T  # so few draws would have another covariance than the stated one
    noise = uncertainty.unresolved_mm * z.reshape(-1, 2, 2)
    return MammographicPair(outlines, nominal, centre, tuple(drawn), noise, refused, uncertainty.unloaded_mm)


_Draw = tuple[tuple[CompressionParameters, CompressionParameters], tuple[float, float], float]


def _draws(
    random: np.random.Generator,
    draws: int,
    parameters: CompressionParameters,
    sds: ModelUncertainty,
    thickness_mm: tuple[float, float],
    angle_deg: float,
) -> Iterator[_Draw]:
    for z in random.standard_normal((draws, 9)):
        pair = [
            replace(
                parameters,
                volume_ratio=float(np.clip(parameters.volume_ratio + sds.volume_ratio * a, 0.5, 1.5)),
                along_share=float(np.clip(parameters.along_share + sds.along_share * b, -0.5, 1.5)),
                bending=float(np.clip(parameters.bending + sds.bending * c, -1.0, 1.5)),
            )
            for a, b, c in z[:6].reshape(2, 3)
        ]
        plates = tuple(max(t + sds.thickness_mm * dz, 0.1 * t) for t, dz in zip(thickness_mm, z[6:8], strict=True))
        yield (pair[0], pair[1]), (plates[0], plates[1]), float(np.clip(angle_deg + sds.angle_deg * z[8], LEAST_ANGLE, MOST_ANGLE))
