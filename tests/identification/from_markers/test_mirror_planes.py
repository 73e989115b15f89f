"""A quarter of an object between side plates stands for the whole of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Loading
from naibu.identification.from_markers.specimen.mirror_planes import MirrorPlanes
from naibu.identification.from_markers.specimen.parameter_names import (
    friction,
    platen_position,
    poisson_ratio,
    side_plate_tilt,
    straight_base,
    young_modulus,
)
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box_from_coordinates
from naibu.meshing.quality import scaled_jacobians


# friction remembers the load steps, which must be the same for both bodies: short ones are not divided
@pytest.mark.parametrize(("tilt", "largest_step"), [(0.0, 0.2), (0.02, 0.05)])
def test_a_quarter_deforms_as_the_whole_object_does(tilt: float, largest_step: float) -> None:
    """The half ellipsoid on a straight base, squeezed by a sixth: markers, gradients and reactions, computed with no symmetry assumed."""
    settings = SolverSettings(first_step=0.5 * largest_step, largest_step=largest_step, tolerance=1e-9)
    experiment = datasets.load("ct_half_ellipsoid")
    gel, state = experiment.materials[0], "width_100"
    values = {young_modulus(gel): 200.0, poisson_ratio(gel): 0.48, straight_base(experiment): 12.0}
    values |= {platen_position(experiment, state): 110.0, side_plate_tilt(experiment, state): tilt}
    values |= {friction(gel, body): mu for body, mu in (("table", 0.2), ("acrylic", 0.1))}
    found = []
    for whole in (False, True):
        body = specimen(experiment, ModelSettings(element_size_mm=16.0), whole=whole)
        solution = solve(body.problem(values, state), settings=settings)
        now = body.reshaped(values)
        moved = now.at_markers(solution.displacement)
        found.append((body, moved, now.deformation_gradient(solution.displacement), body.reactions(solution), now.whole, solution))
    quarter, complete = found
    assert quarter[0].mesh.n_cells * 4 == complete[0].mesh.n_cells
    assert np.abs(complete[1]).max() > 5.0
    np.testing.assert_allclose(quarter[1], complete[1], atol=2e-3)
    np.testing.assert_allclose(quarter[2], complete[2], atol=1e-3)
    for name, force in complete[3].items():
        np.testing.assert_allclose(quarter[3][name], force, atol=2e-3 * 1e5, err_msg=name)
    assert quarter[3]["base of table"][2] > 1e3
    mesh = quarter[4].mesh
    assert (mesh.n_points, mesh.n_cells) == (complete[0].mesh.n_points, complete[0].mesh.n_cells)
    assert elements(mesh).volume == pytest.approx(elements(complete[4].mesh).volume, rel=1e-9)
    assert scaled_jacobians(mesh).min() > 0.1
    field = quarter[4].field(quarter[5].displacement)
    order, other = (np.lexsort(np.round(m.points, 4).T) for m in (mesh, complete[4].mesh))
    np.testing.assert_allclose(field[order], complete[5].displacement[other], atol=2e-3)


def test_what_may_tilt_is_modelled_whole_and_planes_part_cells() -> None:
    cube = datasets.load("ct_cube_plate")
    assert MirrorPlanes.of(cube).axes == ()
    assert MirrorPlanes.of(replace(cube, loading=Loading("side_plates", bar_axis="y"))).axes == (0, 1)
    thirds = np.linspace(-15.0, 15.0, 4)
    with pytest.raises(InputError, match="even number of cells"):
        MirrorPlanes((0, 1)).part(box_from_coordinates(thirds, thirds, thirds))
