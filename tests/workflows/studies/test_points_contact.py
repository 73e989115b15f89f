"""Bodies whose points hand displacement or force over to a face, in studies: balance of forces, weights, and mistakes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lattice_studies import study_file

from naibu.core.errors import InputError
from naibu.mechanics.lattices.simulation.loading_history import run_study
from naibu.workflows.studies.lattice_study import prepared_study

STUDY = """
[object]
size_mm = [40, 40, 20]
mass_g = 30.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 40.0
C1 = 2.0
C2 = inf
[simulation]
duration_s = 1.0
[floor]
[[indenter]]
name = "stamp"
shape = "box"
size_mm = [10, 20, 10]
centre_mm = [20.0, 20.0, 25.0]
contact = "points"
points_mm = 5.0
{moved}
[output]
every_s = 0.02
"""
PATH = "path = [[0.0, 0, 0, 0], [0.2, 0, 0, -2]]"
FORCE = "force = [[0.0, 0.0], [0.2, 900.0]]\ndirection = [0, 0, -1]"


def test_nodes_around_the_edge_follow_in_part(tmp_path: Path) -> None:
    """Points 5 mm apart between nodes 10 mm apart: those within a quarter of a cell stand on a node, others share by distance."""
    study = prepared_study(study_file(tmp_path, STUDY.format(moved=PATH))).study
    *_, last = run_study(study)
    fall = -2.0 - 0.0
    top = {(x, y): k for k, (x, y, z) in enumerate(study.lattice.points) if z == 20.0}
    moved = last.state.lattice.position[:, 2] - study.lattice.points[:, 2]
    # along x points at 15, 20, 25: the middle node takes 1/2 + 1 + 1/2, its neighbours 1/2 of each of five rows of points
    assert moved[top[20.0, 20.0]] == pytest.approx(fall)
    weights = {0.0: 0.0, 10.0: 1.5, 20.0: 2.0, 30.0: 1.5, 40.0: 0.0}  # of points at 10, 15, 20, 25, 30 along y
    for y, along in weights.items():
        assert moved[top[10.0, y]] == pytest.approx(fall * min(0.5 * along, 1.0)) or along == 0.0
    assert abs(moved[top[0.0, 20.0]]) < 0.7


def test_a_force_is_shared_and_carried_by_the_floor(tmp_path: Path) -> None:
    study = prepared_study(study_file(tmp_path, STUDY.format(moved=FORCE))).study
    frames = list(run_study(study))
    rest = frames[-1]
    assert rest.force[-1, 1] == pytest.approx([0.0, 0.0, -900.0])
    assert rest.force[-1, 0, 2] == pytest.approx(900.0, rel=0.01)
    moved = study.bodies[1].points.shares(study.lattice) @ (rest.state.lattice.position - study.lattice.points)
    np.testing.assert_allclose(rest.state.positions[1] - study.bodies[1].indenter.centre, moved, atol=1e-9)
    assert moved[2] < -0.1
    # at rest the work is what the springs store and the dashpots have taken: half of force times way at least
    assert rest.state.work[1] > 0.5 * 900.0 * -moved[2]


def test_a_displacement_and_the_force_that_it_needs_agree(tmp_path: Path) -> None:
    """On one node both ways push alike: the way under the force that a way needs is that way."""
    one = STUDY.replace("size_mm = [10, 20, 10]", "size_mm = [1, 1, 10]").replace("points_mm = 5.0", "points_mm = 2.0")
    *_, by_way = run_study(prepared_study(study_file(tmp_path, one.format(moved=PATH))).study)
    needed = -by_way.force[-1, 1, 2]
    moved = f"force = [[0.0, 0.0], [0.2, {needed}]]\ndirection = [0, 0, -1]"
    *_, by_force = run_study(prepared_study(study_file(tmp_path, one.format(moved=moved))).study)
    assert by_force.state.positions[1, 2] - 25.0 == pytest.approx(-2.0, rel=0.01)


@pytest.mark.parametrize(
    ("change", "to", "words"),
    [
        ('shape = "box"\nsize_mm = [10, 20, 10]', 'shape = "sphere"\nradius_mm = 5.0', ("flat side", "sphere")),
        ("[20.0, 20.0, 25.0]", "[20.0, 20.0, 26.0]", ("outermost face", "centre_mm")),
        ("[20.0, 20.0, 25.0]", "[70.0, 20.0, 25.0]", ("none of the points",)),
        ("direction = [0, 0, -1]", "direction = [0, 0, -1]\nmass_g = 3.0", ("mass_g", "no mass")),
    ],
)
def test_mistakes_are_told(tmp_path: Path, change: str, to: str, words: tuple[str, ...]) -> None:
    text = STUDY.format(moved=FORCE)
    assert change in text
    with pytest.raises(InputError) as told:
        prepared_study(study_file(tmp_path, text.replace(change, to)))
    assert all(word in str(told.value) for word in words)
