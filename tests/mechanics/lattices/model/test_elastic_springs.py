"""Springs from moduli, against the energy of the elastic solid in uniform strain and finite elements of a pressed block with a lump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.elastic_springs import POISSON_RATIO, elastic_stiffness
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice


def springs_energy(lattice: Lattice, stiffness: np.ndarray, strain: np.ndarray) -> float:
    """Energy of springs in a uniform small strain."""
    along = np.diff(lattice.points[lattice.elements], axis=1)[:, 0]
    lengthening = ((along @ strain) * along).sum(axis=1) / np.linalg.norm(along, axis=1)
    return float(0.5 * (stiffness * lengthening**2).sum())


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_the_energy_of_a_uniform_strain_is_that_of_the_solid(seed: int) -> None:
    """Of any shape, its surface included, with a modulus of its own in every cube."""
    rng = np.random.default_rng(seed)
    mask = rng.random((3, 3, 2)) < 0.7
    mask[1, 1, :], mask[1, :, 0] = True, True
    mask &= np.isin(np.arange(mask.size).reshape(mask.shape), piece_of(mask))
    lattice = classic_lattice(mask, 7.0, density=1e-6)
    modulus = rng.uniform(2.0, 90.0, len(lattice.cells))
    strain = rng.normal(size=(3, 3))
    strain += strain.T
    lame = modulus * POISSON_RATIO / ((1 + POISSON_RATIO) * (1 - 2 * POISSON_RATIO))
    shear = modulus / (2 * (1 + POISSON_RATIO))
    solid = 7.0**3 * (0.5 * lame * np.trace(strain) ** 2 + shear * (strain**2).sum()).sum()
    assert springs_energy(lattice, elastic_stiffness(lattice, modulus), strain) == pytest.approx(float(solid), rel=1e-12)


def piece_of(mask: np.ndarray) -> np.ndarray:
    """Numbers of the voxels that hang together by faces with the one in the middle."""
    pieces, _ = label(mask)
    return np.flatnonzero(pieces == pieces[1, 1, 0])


def test_lattices_without_cubes_and_wrong_moduli_are_refused() -> None:
    lattice = classic_lattice(box_mask((2, 2, 2)), 10.0, density=1e-6)
    with pytest.raises(InputError, match="one for each of 8 cubes"):
        elastic_stiffness(lattice, np.ones(7))
    with pytest.raises(InputError, match="cube 3 is 0 kPa"):
        elastic_stiffness(lattice, np.where(np.arange(8) == 3, 0.0, 1.0))
    with pytest.raises(InputError, match="classic"):
        elastic_stiffness(replace(lattice, cells=None), 10.0)
