"""Tecplot text files (``.dat``), as DaVis and other programs export points with displacements.

A header names the variables (``VARIABLES = "x[mm]" "y[mm]" ...``) and the zone (``I=, J=, K=``, ``DATAPACKING`` or ``F``); rows of numbers
follow, a point each. See the Tecplot Data Format Guide.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.reading import read_bytes

_ROW = re.compile(r"\s*[-+.\d]")


def read_columns(source: Path) -> tuple[list[str], FloatArray]:
    """Return the names of the variables and their values, one row a point.

    Raises
    ------
    InputError
        No variables, several zones, values by blocks, or rows that do not fit.
    """
    lines = read_bytes(source).decode("utf-8-sig", "replace").splitlines()
    start = next((k for k, line in enumerate(lines) if _ROW.match(line)), len(lines))
    head, rows = "\n".join(line for line in lines[:start] if not line.lstrip().startswith("#")), lines[start:]
    variables = re.search(r"VARIABLES\s*=(.*?)(?=\bZONE\b|\bDATASETAUXDATA\b|\Z)", head, re.IGNORECASE | re.DOTALL)
    names = re.findall(r'"([^"]*)"', variables[1]) if variables else []
    if variables and not names:
        names = variables[1].replace(",", " ").split()
    if not names:
        raise InputError(f'{source.name}: is no Tecplot text file: it has no line VARIABLES = "x" "y" "z" ...; export it as text')
    if re.search(r"DATAPACKING\s*=\s*BLOCK|\bF\s*=\s*(?:FE)?BLOCK", head, re.IGNORECASE):
        raise InputError(f"{source.name}: stores its values by blocks; export it with DATAPACKING=POINT")
    found = [(start + k + 1, row) for k, row in enumerate(rows) if row.strip() and not row.lstrip().startswith("#")]
    values = np.empty((len(found), len(names)))
    for k, (line, row) in enumerate(found):
        cells = row.replace(",", " ").split()
        if re.match(r"\s*ZONE", row, re.IGNORECASE):
            raise InputError(f"{source.name}: line {line}: a second zone begins; export one state at a time")
        try:
            values[k] = [float(cell) for cell in cells]
        except ValueError as error:
            raise InputError(f"{source.name}: line {line} holds no {len(names)} numbers ({row.strip()[:60]!r}); export it again") from error
    return names, values
