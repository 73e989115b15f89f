"""A body whose moduli were identified from displacement fields: its mesh, zones, moduli with their covariance, and how well they fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.forward_model import whitening
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, KnownRegion, Zones
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.identification.from_fields.forward.sensitivities import logarithms, young_and_poisson
from naibu.identification.from_fields.forward.zones_within_cells import RegionAt, logarithms_of_regions, parts_within_cells
from naibu.identification.from_fields.identified.stored_body import UNITS_OF_MULTIPLES, check_stored_body
from naibu.identification.stored_values import UNITS
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

FORMAT = "naibu field model 1"


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedBody:
    """What an identification from displacement fields hands on.

    Attributes
    ----------
    mesh : Mesh
        Cells of the body, in the frame of the scan.
    axes : ndarray, shape (3, 3)
        Axes of the grid of cells in the frame of the scan, in columns.
    zones : tuple of str
        Names of the zones that were identified.
    parts : csr_matrix, shape (m, k + known regions)
        Part of every cell in each of these zones and of the known regions, by which logarithms of moduli are mixed; an empty row where
        moduli are known.
    theta : ndarray, shape (2 k,)
        ln mu, then ln(kappa / mu), of the zones; kPa.
    covariance : ndarray, shape (2 k, 2 k), or None
        Of theta; None where the zones were too many.
    known : tuple of KnownRegion
        Regions whose moduli were known.
    known_of_cell : ndarray, shape (m,), int64
        Index into `known` of every cell, -1 where its moduli were identified.
    law : {"linear", "neo_hookean"}
        Small strain, or compressible neo-Hookean at finite strain.
    relative : bool
        Whether moduli are multiples of that of a zone whose modulus was not stated.
    noise_mm, noise_factor : float
        Root mean square standard deviation of the measurements, mm, and residuals in units of it.
    strain : float
        Largest part of its extent by which a load case deformed the body.
    load_cases : tuple of str
        Names of the fields.
    reservation : str
        What speaks against using the model; empty where nothing does.
    provenance : mapping
        Version, settings, hashes of the inputs.
    eighths : csr_matrix, shape (8 m, k + known regions), or None
        `parts` of the cells of half the size, where zones end inside of cells and moduli were corrected for that; None where all eighths
        of a cell are alike.
    """

    mesh: Mesh
    axes: FloatArray
    zones: tuple[str, ...]
    parts: sp.csr_matrix
    theta: FloatArray
    covariance: FloatArray | None
    known: tuple[KnownRegion, ...]
    known_of_cell: IntArray
    law: LawName
    relative: bool
    noise_mm: float
    noise_factor: float
    strain: float
    load_cases: tuple[str, ...]
    reservation: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    eighths: sp.csr_matrix | None = None

    @classmethod
    def of(
        cls,
        found: FieldEstimate,
        *,
        axes: FloatArray,
        law: LawName,
        relative: bool,
        strain: float,
        load_cases: Sequence[FieldLoadCase],
        provenance: Mapping[str, Any],
        region_at: RegionAt | None = None,
    ) -> IdentifiedBody:
        """Take the body from an estimate on a mesh in three dimensions.

        Where zones end inside of cells and moduli were corrected for that, with `region_at` (see
        `naibu.identification.from_fields.estimate.identify_field`), cells get the moduli of what lies in them.
        """
        zones, covariance = found.zones, None if found.uncertainty is None else found.uncertainty.covariance
        parts = zones_of_cells(zones) if found.parts is None else _padded(found.parts, len(zones.known))
        known_of_cell = np.full(found.mesh.n_cells, KNOWN, dtype=np.int64) if zones.region_of_cell is None else zones.region_of_cell
        eighths: sp.csr_matrix | None = None
        if region_at is not None and found.mesh_shift is not None:
            parts, known_of_cell, eighths = _parts_within(found.mesh, zones, region_at)
        doubtful = found.verdict is not None and (not found.verdict.ok or bool(found.verdict.limits))
        noise = float(np.sqrt(np.mean([whitening(case.field, case.name)[1] ** 2 for case in load_cases])))
        return cls(
            found.mesh, axes, zones.names, parts, found.theta,
            covariance if covariance is not None and np.isfinite(covariance).all() else None, zones.known, known_of_cell, law, relative,
            noise, found.noise_factor, strain, tuple(case.name for case in load_cases),
            found.verdict.sentence if found.verdict is not None and doubtful else "", provenance, eighths,
        )  # fmt: skip

    @classmethod
    def stated(
        cls, mesh: Mesh, zones: Zones, young_modulus: FloatArray, poisson_ratio: FloatArray, *, axes: FloatArray, law: LawName
    ) -> IdentifiedBody:
        """Return a body of stated moduli of its zones (k,), kPa, that are exactly known, as a truth to plan with."""
        lame, shear = np.array([lame_parameters(e, nu) for e, nu in zip(young_modulus, poisson_ratio, strict=True)]).T
        known_of_cell = np.full(mesh.n_cells, KNOWN, dtype=np.int64) if zones.region_of_cell is None else zones.region_of_cell
        return cls(
            mesh, axes, zones.names, zones_of_cells(zones), logarithms(lame, shear), None, zones.known, known_of_cell, law, False, 0.0, 1.0,
            0.0, (),
        )  # fmt: skip

    def refined(self) -> IdentifiedBody:
        """Return the body on a mesh of half the element size."""
        every = np.repeat(np.arange(self.mesh.n_cells), 8)
        parts = sp.csr_matrix(self.parts[every]) if self.eighths is None else self.eighths
        return replace(self, mesh=Refinement.of(self.mesh).mesh, parts=parts, known_of_cell=self.known_of_cell[every], eighths=None)

    @property
    def unit(self) -> str:
        """Unit of Young's modulus, in words where it is a modulus that was not stated."""
        if not self.relative or self.known:
            return "multiples of the known zone" if self.relative else "kPa"
        cell_by_cell = 2 * len(self.zones) > self.mesh.n_cells  # a map that no regions explain
        return "multiples of the median" if cell_by_cell else "multiples of the largest region"

    @property
    def cell_zones(self) -> Zones:
        """The cells as zones of their own, those of known moduli left out."""
        unknown = self.known_of_cell == KNOWN
        of_cell = np.full(self.mesh.n_cells, KNOWN, dtype=np.int64)
        of_cell[unknown] = np.arange(int(unknown.sum()))
        lame, shear = np.full(self.mesh.n_cells, np.nan), np.full(self.mesh.n_cells, np.nan)
        for number, region in enumerate(self.known):
            there = self.known_of_cell == number
            lame[there], shear[there] = lame_parameters(region.young_modulus, region.poisson_ratio)
        names = tuple(f"cell {c}" for c in np.flatnonzero(unknown))
        return Zones(of_cell, names, lame, shear, self.known, self.known_of_cell)

    @property
    def mixing(self) -> sp.csr_matrix:
        """Matrix (2 cells, 2 k) from theta of the zones to that of the cells that are not known, as `cell_zones` numbers them."""
        return sp.csr_matrix(sp.kron(sp.identity(2), self.parts[self.known_of_cell == KNOWN][:, : len(self.zones)]))

    @property
    def theta_of_cells(self) -> FloatArray:
        """Ln mu, then ln(kappa / mu), of the cells that are not known; kPa."""
        mixed = self.parts[self.known_of_cell == KNOWN] @ logarithms_of_regions(self.theta, self.known)
        return np.asarray(mixed).T.ravel()

    @property
    def spread(self) -> FloatArray:
        """Factor S (2 k, 2 k) of the covariance of theta, which is S S'; without columns where there is none."""
        if self.covariance is None:
            return np.zeros((len(self.theta), 0))
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @property
    def discrepancy_mm(self) -> float:
        """Root mean square of what the model leaves of a displacement beyond the noise of its measurement, mm a component."""
        return self.noise_mm * float(np.sqrt(max(self.noise_factor**2 - 1.0, 0.0)))

    def lame_of_cells(self) -> tuple[FloatArray, FloatArray]:
        """Return lambda and mu of every cell (m,), kPa, known ones included."""
        shear, ratio = np.exp(self.theta_of_cells.reshape(2, -1))
        return self.cell_zones.per_cell(shear * (ratio - 2.0 / 3.0), shear)

    def moduli(self) -> list[tuple[str, float, float]]:
        """Return name, Young's modulus, kPa, and Poisson's ratio of every zone, known ones last."""
        young, poisson = young_and_poisson(self.theta)
        found = [(name, float(e), float(nu)) for name, e, nu in zip(self.zones, young, poisson, strict=True)]
        return [*found, *((region.name, region.young_modulus, region.poisson_ratio) for region in self.known)]

    def to_dict(self) -> dict[str, Any]:
        """Return the body as plain numbers and strings, for JSON."""
        return {
            "format": FORMAT,
            "units": UNITS_OF_MULTIPLES if self.relative else UNITS,
            "law": self.law,
            "relative": self.relative,
            "zones": [{"name": name} for name in self.zones],
            "theta": self.theta.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "known": [
                {
                    "name": r.name, "young_modulus": r.young_modulus, "poisson_ratio": r.poisson_ratio,
                    "young_modulus_sd": r.young_modulus_sd, "poisson_ratio_sd": r.poisson_ratio_sd,
                }
                for r in self.known
            ],
            "noise_mm": self.noise_mm,
            "noise_factor": self.noise_factor,
            "strain": self.strain,
            "load_cases": list(self.load_cases),
            "reservation": self.reservation,
            "provenance": dict(self.provenance),
            "axes": self.axes.tolist(),
            "cell_type": self.mesh.cell_type,
            "points": self.mesh.points.tolist(),
            "cells": self.mesh.cells.tolist(),
            "known_of_cell": self.known_of_cell.tolist(),
            "parts": _triples(self.parts),
            "eighths": None if self.eighths is None else _triples(self.eighths),
        }  # fmt: skip

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> IdentifiedBody:
        """Return the body that `to_dict` wrote.

        Raises
        ------
        InputError
            Another format, or a missing or unusable entry.
        """
        if data.get("format") != FORMAT:
            raise InputError(f"this is not a naibu model of displacement fields: its format is {data.get('format')!r}, not {FORMAT!r}")
        check_stored_body(data)
        names = tuple(row["name"] for row in data["zones"])
        regions, known_of_cell = tuple(KnownRegion(**row) for row in data["known"]), np.array(data["known_of_cell"], dtype=np.int64)
        shape = len(data["cells"]), len(names) + len(regions)
        parts = _of_triples(data["parts"], shape)
        eighths = None if data.get("eighths") is None else _of_triples(data["eighths"], (8 * shape[0], shape[1]))
        place = np.where(known_of_cell == KNOWN, np.asarray(parts.argmax(axis=1)).ravel(), len(names) + known_of_cell)
        mesh = Mesh.from_arrays(
            data["points"], data["cells"], data["cell_type"], regions=place, region_names=(*names, *(r.name for r in regions))
        )
        covariance = None if data["covariance"] is None else np.array(data["covariance"], dtype=float)
        return cls(
            mesh, np.array(data["axes"], dtype=float), names, parts, np.array(data["theta"], dtype=float), covariance, regions,
            known_of_cell, data["law"], data["relative"], float(data["noise_mm"]), float(data["noise_factor"]), float(data["strain"]),
            tuple(data["load_cases"]), data["reservation"], data["provenance"], eighths,
        )  # fmt: skip


def zones_of_cells(zones: Zones) -> sp.csr_matrix:
    """Return the part of every cell in each zone (m, k + known regions): one zone a cell, none where moduli are known."""
    cells = np.flatnonzero(zones.of_cell != KNOWN)
    shape = len(zones.of_cell), zones.count + len(zones.known)
    return sp.csr_matrix((np.ones(len(cells)), (cells, zones.of_cell[cells])), shape=shape)


def _parts_within(mesh: Mesh, zones: Zones, region_at: RegionAt) -> tuple[sp.csr_matrix, IntArray, sp.csr_matrix]:
    """Return parts, known regions of cells, and parts of their eighths, of zones that end inside of cells."""
    eighths = parts_within_cells(Refinement.of(mesh).mesh, zones, region_at)
    mean = sp.csr_matrix(sp.kron(sp.identity(mesh.n_cells), np.full((1, 8), 0.125)))
    parts = sp.csr_matrix(mean @ eighths)
    in_one = np.diff(parts.indptr) == 1
    region = np.asarray(parts.argmax(axis=1)).ravel() - zones.count
    known_of_cell = np.where(in_one & (region >= 0), region, KNOWN)
    unknown = (known_of_cell == KNOWN).astype(float)
    kept = [sp.csr_matrix(sp.diags(np.repeat(unknown, n)) @ p) for n, p in ((1, parts), (8, eighths))]
    for matrix in kept:
        matrix.eliminate_zeros()
    return kept[0], known_of_cell, kept[1]


def _padded(parts: FloatArray, known: int) -> sp.csr_matrix:
    """Return parts in zones (m, k) with a column of zeros for each known region."""
    return sp.csr_matrix(np.pad(parts, ((0, 0), (0, known))))


def _triples(parts: sp.csr_matrix) -> list[list[float]]:
    at = parts.tocoo()
    return [[int(c), int(z), float(v)] for c, z, v in zip(at.row, at.col, at.data, strict=True)]


def _of_triples(triples: Sequence[Sequence[float]], shape: tuple[int, int]) -> sp.csr_matrix:
    rows, columns, values = np.array(triples, dtype=float).reshape(-1, 3).T
    return sp.csr_matrix((values, (rows.astype(np.int64), columns.astype(np.int64))), shape=shape)
