"""What else than the moduli may cause what a fit leaves: another law, borders, surface or readings; which of them the verdict blames first.

Causes look alike in part, and one that explains more takes the place of those that explain less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.assumptions.averaged_displacements import Averaging, averaging, judged_averages
from naibu.identification.from_fields.assumptions.eigenstrain import Eigenstrain, asked_eigenstrain, judged_eigenstrain
from naibu.identification.from_fields.assumptions.free_surface import SurfacePlace, asked_surface, judged_surface
from naibu.identification.from_fields.assumptions.known_ratios import AskedRatio, judged_ratios
from naibu.identification.from_fields.assumptions.other_readings import Reading, covariance_of_readings, judged_readings, other_readings
from naibu.identification.from_fields.assumptions.scaled_displacements import (
    EXPLAINS,
    Scaling,
    asked_scaling,
    judged_scaling,
    unless_explained,
)
from naibu.identification.from_fields.assumptions.score_test import MOST_OF_RATIO, ScoreTest
from naibu.identification.from_fields.assumptions.sliding_borders import Sliding, asked_sliding, judged_sliding
from naibu.identification.from_fields.assumptions.unlike_experiments import Difference, asked_difference, judged_difference
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Point
from naibu.identification.from_fields.inversion.gauss_newton import Bounds
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.identification.verdict import Verdict

BY_CHANCE = 3.0  # standard deviations of chi squared that noise leaves


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """The best fit of which other causes are asked.

    Attributes
    ----------
    test : ScoreTest
    point : Point
        The best fit itself; that of the test is without bias.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    residuals : sequence of ndarray, shape (q,)
        The best whitened residuals that are known.
    beyond_noise : float
        Chi squared less what noise leaves on average.
    bounds : Bounds
        Of the moduli.
    """

    test: ScoreTest
    point: Point
    variance: float
    stretch: FloatArray
    residuals: Sequence[FloatArray]
    beyond_noise: float
    bounds: Bounds

    @property
    def by_elements(self) -> float:
        """By how much chi squared falls with elements of half the size, where these leave no more than noise does; 0 where they do."""
        misfit = sum(float(r @ r) for r in self.residuals)
        by_chance = BY_CHANCE * float(np.sqrt(2.0 * max(misfit - self.beyond_noise, 0.0)))
        return max(0.0, self.point.misfit - misfit) if self.beyond_noise <= by_chance else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class OtherCauses:
    """What fields ask for besides moduli and another law; None or empty where for nothing.

    Attributes
    ----------
    of_law : float
        By how much chi squared falls with another law or known ratio.
    beyond_noise : float
        Chi squared less what noise leaves on average.
    ratios : tuple of AskedRatio
    readings : tuple of Reading
        Those that were tried.
    averages : Averaging or None
    scaling : Scaling or None
    sliding : Sliding or None
    surface : SurfacePlace or None
    eigenstrain : Eigenstrain or None
    difference : Difference or None
    """

    of_law: float
    beyond_noise: float
    ratios: tuple[AskedRatio, ...]
    readings: tuple[Reading, ...]
    averages: Averaging | None
    scaling: Scaling | None
    sliding: Sliding | None
    surface: SurfacePlace | None
    eigenstrain: Eigenstrain | None
    difference: Difference | None

    @property
    def explained(self) -> float:
        """By how much chi squared falls at least with a cause that comes first: more than with another law, and by half of what is left."""
        return max(self.of_law, EXPLAINS * self.beyond_noise)

    @property
    def _each(self) -> tuple[Averaging | Scaling | Sliding | SurfacePlace | Eigenstrain | Difference | None, ...]:
        return self.averages, self.scaling, self.sliding, self.surface, self.eigenstrain, self.difference

    @property
    def accounted(self) -> float:
        """By how much chi squared falls with the one that explains most of those of which `covariance` holds the effect.

        That of one which changes a logarithm by `MOST_OF_RATIO` or more is not known to first order.
        """
        those = (*self.ratios, self.scaling, self.sliding, self.surface, self.eigenstrain, self.difference)
        each = [one.fall for one in those if one is not None and np.abs(one.theta).max() < MOST_OF_RATIO]
        return max([*each, *(one.gain for one in self.readings if one.likelier)], default=0.0)

    @classmethod
    def asked(cls, fit: Fitted, judged: Verdict, of_law: float, ratios: tuple[AskedRatio, ...], *, of_map: bool) -> OtherCauses:
        """Ask for each of them.

        Parameters
        ----------
        fit : Fitted
        judged : Verdict
            On the residuals and the law.
        of_law : float
            By how much chi squared falls with the shape of the law free.
        ratios : tuple of AskedRatio
            Of known zones.
        of_map : bool
            Whether borders of regions run through cells, in whose place displacements are not discontinuous and surfaces not free.
        """
        test, variance, stretch = fit.test, fit.variance, fit.stretch
        averages = averaging(test, fit.residuals, stretch, fit.bounds)
        sliding = None if of_map else asked_sliding(test, variance, stretch)
        surface = None if of_map or fit.beyond_noise <= 0.0 else asked_surface(test, variance, stretch)  # averages leave less than noise
        of_geometry = max((one.fall for one in (sliding, surface) if one is not None), default=0.0)
        eigenstrain = None if of_map else asked_eigenstrain(test, variance, stretch)
        if eigenstrain is not None and eigenstrain.fall <= max(of_law, of_geometry):
            eigenstrain = None  # what explains more looks like it
        difference = asked_difference(test, variance, stretch)
        if difference is not None and difference.fall <= max(of_law, of_geometry):
            difference = None  # at another strain, a body of another law is stiffer as well
        of_any = max(of_geometry, *(0.0 if one is None else one.fall for one in (eigenstrain, difference)))
        scaling = unless_explained(asked_scaling(test, variance, stretch), judged, of_law, of_any)
        readings = other_readings(test.at.model, fit.point, max(of_law, of_any), fit.by_elements, variance, fit.bounds)
        of_law = max(of_law, *[one.fall for one in ratios]) if ratios else of_law
        explained = max(of_law, EXPLAINS * fit.beyond_noise)
        averages = None if of_geometry > explained else averages  # neighbours share what a jump or a wrong surface leaves as well
        return cls(of_law, fit.beyond_noise, ratios, readings, averages, scaling, sliding, surface, eigenstrain, difference)

    def judged(self, judged: Verdict, zones: Zones, theta: FloatArray, total: Uncertainty, *, coarse: bool) -> Verdict:
        """Return the verdict with them, the one that explains most first; see `judged_scaling` for `coarse` elements."""
        judged = judged_readings(judged, self.readings, zones, theta)
        judged = judged_averages(judged_ratios(judged, self.ratios, zones, theta), self.averages, zones, theta)
        judged = judged_scaling(judged, self.scaling, zones, theta, total, self.explained, coarse=coarse)
        there = [one for one in (self.sliding, self.surface, self.eigenstrain, self.difference) if one is not None]
        for one in sorted(there, key=lambda each: each.fall):  # the last one that comes first is the first of all
            if isinstance(one, Sliding):
                judged = judged_sliding(judged, one, zones, theta, self.explained)
            elif isinstance(one, SurfacePlace):
                judged = judged_surface(judged, one, zones, theta, self.of_law, self.beyond_noise)
            elif isinstance(one, Difference):
                judged = judged_difference(judged, one, zones, self.explained)
            else:
                judged = judged_eigenstrain(judged, one, zones, theta, self.explained)
        return judged

    def covariance(self, size: int) -> FloatArray:
        """Return what they leave in doubt of logarithms (size, size), known ratios aside: by as much as they change them."""
        of_each = [np.outer(one.theta, one.theta) for one in self._each if one is not None]
        return covariance_of_readings(self.readings, size) + np.asarray(sum(of_each, np.zeros((size, size))))
