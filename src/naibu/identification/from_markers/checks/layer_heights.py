"""Stated heights of layers against the markers: which boundaries lie elsewhere.

A boundary between layers may lie some way off its stated height, as gels are cast, and is sought within the prior for that. Where the
stated height is wrong, the prior holds the estimate back while other parameters make up for it, and residuals may stay small. What tells is
the estimate without the prior, by one Gauss-Newton step, against its standard deviation from data alone.
"""

from __future__ import annotations

import numpy as np

from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.marker_checks import Doubt
from naibu.identification.from_markers.gauss_newton import Matcher

LAYER = ": shift_of_layer_at_"
CONTRADICTED = 2.5  # standard deviations between the height that the markers show and the stated one


def contradicted_layers(calibration: Calibration) -> tuple[Doubt, ...]:
    """Doubt the stated heights of boundaries between layers that the markers put elsewhere."""
    match = calibration.match
    matcher = Matcher(calibration.load_cases, calibration.priors)
    free = matcher.parameters.free
    if not any(LAYER in p.name for p in free):
        return ()
    values = match.parameters.values()
    inner = np.array([p.inner(values[p.name]) for p in free])
    equations = matcher.normal_equations(match.fits, inner)
    factor = max(1.0, match.noise_factor)
    doubts = []
    for k, p in enumerate(free):
        name, _, stated = p.name.partition(LAYER)
        if not stated or equations.data[k, k] == 0.0:  # nothing was seen of an experiment without a loaded state
            continue
        hessian, gradient = equations.hessian.copy(), equations.gradient.copy()
        hessian[k, k] -= 1.0 / p.prior_sd**2
        gradient[k] += (inner[k] - p.value) / p.prior_sd**2
        shift = inner[k] + float(np.linalg.solve(hessian, gradient)[k])
        # a boundary that is far off distorts the elements, which is no excuse
        elements = 0.0 if calibration.mesh is None else min(abs(float(calibration.mesh.step[k])), p.prior_sd)
        sd = float(np.sqrt(np.linalg.inv(hessian)[k, k] * factor**2 + elements**2 + p.prior_sd**2))
        if abs(shift) > CONTRADICTED * sd:
            text = f"layers of {name} are stated to meet {stated} mm above its base, but the markers say {float(stated) + shift:.0f} mm"
            doubts.append(Doubt(f"{text} ({abs(shift) / sd:.0f} standard deviations): check from_base_mm"))
    return tuple(doubts)
