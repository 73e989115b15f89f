"""The same measurement gives the same moduli to the last digit, on several threads and beside other processes as well."""

import os
import subprocess
import sys

IDENTIFIED = """
import numpy as np
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.gauss_newton import Objective, SearchSettings, first_point, search
from naibu.meshing.primitives import box
from naibu.meshing.surface import side_nodes

rng = np.random.default_rng(0)
mesh = box((50.0, 50.0, 50.0), (10, 10, 10), layers=[("low", 25.0), ("high", 25.0)])
points = rng.uniform(mesh.points.min(axis=0), mesh.points.max(axis=0), (1200, 3))
moved = np.column_stack([0.02 * points[:, 0], 0.02 * points[:, 1], -0.04 * points[:, 2] - 2e-4 * points[:, 2] ** 2])
field = DisplacementField.from_arrays(points, moved + 0.02 * rng.standard_normal(points.shape), sd_mm=0.02)
loaded = np.zeros(mesh.n_points, dtype=bool)
loaded[[*side_nodes(mesh, "z-"), *side_nodes(mesh, "z+")]] = True
case, zones = FieldLoadCase.of("push", field, mesh, loaded=loaded), Zones.of(mesh, known={"high": (10.0, 0.45)})
model = FieldModel(mesh, [case], zones, "neo_hookean")
found = search(model, first_point(model, np.zeros(2)), Objective(), SearchSettings(max_iterations=2)).point
print(*(float(x).hex() for x in (*found.theta, *found.states[0].ravel())))
"""


def test_two_runs_at_once_on_two_threads_each_give_the_same_digits() -> None:
    two = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", IDENTIFIED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | two
        )
        for _ in range(2)
    ]
    said = [run.communicate(timeout=600) for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    assert said[0][0] == said[1][0]
    assert "0x" in said[0][0]
