"""Checks of a stored body that was identified from displacement fields: types, ranges, a mesh that is one, and a covariance that is one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from naibu.core.arrays import LENGTHS_MM, FloatArray
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.stored_values import UNITS, array_of, check_covariance, require, require_number, rows_of

UNITS_OF_MULTIPLES = "mm, kg, s; moduli without unit, as multiples of one of them"
LOGARITHMS = 60.0  # of moduli in kPa, beyond which nothing is elastic
ORTHONORMAL = 1e-6
WHOLE = 1e-6  # by which the parts of a cell may miss 1


def check_stored_body(data: Mapping[str, Any]) -> None:
    """Refuse a stored body with a value that cannot be.

    Parameters
    ----------
    data : mapping
        As `naibu.identification.from_fields.identified.identified_body.IdentifiedBody.to_dict` wrote it.

    Raises
    ------
    InputError
        A missing entry, one of another type or out of its range, cells without volume, or a covariance that is none.
    """
    units = (UNITS, UNITS_OF_MULTIPLES) if data.get("relative") else (UNITS,)  # relative ones once said kPa as well
    require(data.get("units") in units, "units", data.get("units"), f"must be {units[-1]!r}")
    require(data.get("law") in get_args(LawName), "law", data.get("law"), f"must be one of {', '.join(get_args(LawName))}")
    require(isinstance(data.get("relative"), bool), "relative", data.get("relative"), "must be true or false")
    require(data.get("cell_type") == "hexahedron", "cell_type", data.get("cell_type"), "must be 'hexahedron'")
    for name in ("noise_mm", "noise_factor", "strain"):
        require_number(name, data.get(name), 0.0, 1e9)
    require(isinstance(data.get("reservation"), str), "reservation", data.get("reservation"), "must be a text")
    require(isinstance(data.get("provenance"), Mapping), "provenance", data.get("provenance"), "must be a table")
    require(all(isinstance(c, str) for c in rows_of(data, "load_cases")), "load_cases", data["load_cases"], "must be names")
    for row in (*rows_of(data, "zones"), *rows_of(data, "known")):
        require(isinstance(row, Mapping) and isinstance(row.get("name"), str), "zones and known", row, "must be tables with a name")
    require(len(data["zones"]) > 0, "zones", data["zones"], "must not be empty")
    for row in data["known"]:
        _check_known(row)
    _check_mesh(data)
    _check_parts(data)
    k = len(data["zones"])
    theta = array_of(data, "theta", (2 * k,))
    require(bool((np.abs(theta) <= LOGARITHMS).all()), "theta", theta.tolist(), f"must lie within {LOGARITHMS:g} of 0")
    if data.get("covariance") is not None:
        check_covariance(data["covariance"], [f"{part} of {row['name']}" for part in ("mu", "kappa / mu") for row in data["zones"]])


def _check_known(row: Mapping[str, Any]) -> None:
    ranges = {
        "young_modulus": (1e-12, 1e12),
        "poisson_ratio": (-0.999, 0.4999),
        "young_modulus_sd": (0.0, 1e3),
        "poisson_ratio_sd": (0.0, 1.0),
    }
    require(set(row) == {"name", *ranges}, "known", sorted(row), f"must have the entries name, {', '.join(ranges)}")
    for name, (low, high) in ranges.items():
        require_number(f"known {row['name']!r} {name}", row[name], low, high)


def _check_mesh(data: Mapping[str, Any]) -> None:
    points, cells = array_of(data, "points", (None, 3)), array_of(data, "cells", (None, 8))
    require(len(cells) > 0, "cells", [], "must not be empty")
    require(float(np.abs(points).max(initial=0.0)) <= LENGTHS_MM[1], "points", "far away", f"must lie within {LENGTHS_MM[1]:g} mm")
    good = (cells == np.round(cells)).all() and cells.min() >= 0 and cells.max() < len(points)
    require(bool(good), "cells", "other nodes", f"must be whole numbers of the {len(points)} points")
    at = points[cells.astype(np.int64)]
    volume = np.einsum("mi,mi->m", np.cross(at[:, 1] - at[:, 0], at[:, 3] - at[:, 0]), at[:, 4] - at[:, 0])
    require(bool((volume > 0.0).all()), "cells", f"cell {int(np.argmin(volume))}", "must have a volume above 0")
    axes = array_of(data, "axes", (3, 3))
    require(bool(np.abs(axes.T @ axes - np.eye(3)).max() <= ORTHONORMAL), "axes", axes.tolist(), "must be orthogonal, of length 1")


def _check_parts(data: Mapping[str, Any]) -> None:
    m = len(data["cells"])
    known = array_of(data, "known_of_cell", (m,))
    good = (known == np.round(known)).all() and known.min() >= -1 and known.max() < len(data["known"])
    require(bool(good), "known_of_cell", "other numbers", "must be -1 or the number of a known region, for every cell")
    _check_triples(data, "parts", known)
    if data.get("eighths") is not None:
        _check_triples(data, "eighths", np.repeat(known, 8))


def _check_triples(data: Mapping[str, Any], name: str, known: FloatArray) -> None:
    m, k = len(known), len(data["zones"]) + len(data["known"])
    rows, columns, values = array_of(data, name, (None, 3)).T
    whole = (rows == np.round(rows)).all() and (columns == np.round(columns)).all()
    good = whole and bool(((rows >= 0) & (rows < m) & (columns >= 0) & (columns < k)).all())
    require(bool(good), name, "other numbers", "must be rows of cell, zone and part")
    require(bool((values >= 0.0).all()), name, float(values.min(initial=0.0)), "must not be negative")
    total = np.bincount(rows.astype(np.int64), values, minlength=m)
    wrong = np.flatnonzero(np.abs(total - (known < 0)) > WHOLE)
    said = f"cell {int(wrong[0]) if len(wrong) else 0}"
    require(not len(wrong), name, said, "must sum to 1 in every cell that is not known, and be 0 there")
