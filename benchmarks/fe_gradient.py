"""The gradient of a least-squares misfit by the moduli of every element: naibu's adjoint beside automatic differentiation by torch-fem.

``python benchmarks/fe_gradient.py [--cells 20] [--repeats 3] [--peers naibu,torch-fem]`` (mm, kPa). The cube of ``fe_linear.py``, its
top lowered by 3 mm; the displacement of all nodes is measured with normal noise of .01 mm, and the moduli of every tetrahedron are
unknown, started at those of the soft part. A run begins with the arrays of the mesh and ends with the derivatives of half the misfit by
the logarithm of Young's modulus of every element: assembly, one solution of the displacement and one of the adjoint.
"""

from __future__ import annotations

import numpy as np
from fe_case import LOWERED, POISSON, SOFT, Case, Result, prescribed
from fe_driver import Peer, main

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

NOISE_MM = 0.01


def measured(case: Case) -> np.ndarray:
    """A uniform compression with noise: what is measured need not be what a body would do."""
    height = case.mesh.points[:, 2] / np.ptp(case.mesh.points[:, 2])
    noise = NOISE_MM * np.random.default_rng(0).standard_normal(case.mesh.points.shape)
    return -LOWERED * np.stack([0.0 * height, 0.0 * height, height], axis=1) + noise


def run_naibu(case: Case) -> Result:
    """As identification does: also by Poisson's ratio and by the displacement of base and top, which are sought as well."""
    support = prescribed(case, LOWERED)
    field = DisplacementField.from_arrays(case.mesh.points, measured(case), sd_mm=NOISE_MM)
    load_case = FieldLoadCase.of("lowered", field, case.mesh, loaded=support.constrained)
    zones = Zones.of(case.mesh, known={}, each_cell=True)
    model = FieldModel(case.mesh, [load_case], zones, elements="as_given")
    lame, shear = (np.full(case.mesh.n_cells, value) for value in lame_parameters(SOFT, POISSON))
    point = model.evaluate(logarithms(lame, shear), [support.values])
    by_shear_at_constant_ratio = model.linearised(point).gradient()[0][zones.of_cell]
    return Result(by_shear_at_constant_ratio[:, None])


def run_torch_fem(case: Case, method: str) -> Result:
    """torch-fem with the adjoint that its solver gives to automatic differentiation."""
    import torch
    from torchfem import Solid
    from torchfem.materials import IsotropicElasticity3D

    torch.set_default_dtype(torch.float64)
    logarithm = torch.full((case.mesh.n_cells,), float(np.log(SOFT)), requires_grad=True)
    young = torch.exp(logarithm)
    body = Solid(
        torch.as_tensor(case.mesh.points), torch.as_tensor(case.mesh.cells), IsotropicElasticity3D(young, torch.full_like(young, POISSON))
    )
    support = prescribed(case, LOWERED)
    body.constraints, body.displacements = torch.as_tensor(support.constrained), torch.as_tensor(support.values)
    u = body.solve(method=method, aggregate_integration_points=False, differentiable_parameters=young)[0]
    misfit = 0.5 * (((u - torch.as_tensor(measured(case))) / NOISE_MM) ** 2).sum()
    misfit.backward()
    return Result(logarithm.grad.numpy()[:, None])


PEERS = {
    "naibu": Peer("naibu", run_naibu, warm_up=20),
    "torch-fem": Peer("torch-fem, its default CG with multigrid", lambda case: run_torch_fem(case, "cg"), ("torch", "torchfem")),
    "torch-fem-direct": Peer("torch-fem, its direct solver", lambda case: run_torch_fem(case, "direct"), ("torch", "torchfem")),
}


if __name__ == "__main__":
    main(__file__, __doc__, PEERS, "naibu,torch-fem")
