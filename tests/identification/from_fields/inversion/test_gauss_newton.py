"""A search ends where the fit is best in all that the data tell, however little they tell of the rest."""

from __future__ import annotations

import numpy as np
from gel_under_a_plate import gel_under_a_plate

from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.gauss_newton import Objective, first_point, search


def test_moduli_that_are_told_as_multiples_only_do_not_stop_the_search_of_these_multiples() -> None:
    """The shear moduli of both gels together are told by nothing; from wherever that of one starts, one and the same ratio fits best."""
    mesh, zones, load_case = gel_under_a_plate()
    model, ratios = FieldModel(mesh, [load_case], zones, elements="as_given"), []
    for stiffer in (1.0, 5.0):
        start = np.array([np.log(0.02), np.log(0.02 * stiffer), 2.0, 2.0])
        point = search(model, first_point(model, start), Objective()).point
        ratios.append(point.theta[1] - point.theta[0])
    np.testing.assert_allclose(ratios[0], ratios[1], atol=0.02)
