"""Tables of numbers as programs and spreadsheets of other countries write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.tables.number_table import read_number_rows, read_numbers

NUMBERS = [[20.5, -2.0, 22.0], [20.0, 30.0, 22.25]]


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z\n20.5,-2,22\n20,30,22.25\n",
        "# a blade\nx;y;z\n20,5;-2;22\n20;30;22,25\n",
        "20.5;-2;22\n20;30;22.25\n",
        "x;y;z\n20,5;-2,0;22,0\n20,0;30,0;22,25\n",
        "x\ty\tz\n20,5\t-2\t22\n20\t30\t22,25\n",
    ],
)
def test_separators_and_decimal_commas(tmp_path: Path, text: str) -> None:
    (tmp_path / "blade.csv").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_number_rows(tmp_path / "blade.csv"), NUMBERS)


def test_units_are_read_beside_semicolons(tmp_path: Path) -> None:
    (tmp_path / "volts.csv").write_text("t_s;F_mV\n0,5;2\n", encoding="utf-8")
    with pytest.raises(InputError, match="column 'F_mV' is in mV; convert it to V"):
        read_numbers(tmp_path / "volts.csv", ("time", "force"), units=("s", "V"))


def test_what_is_no_number_is_named(tmp_path: Path) -> None:
    (tmp_path / "blade.csv").write_text("x;y\n1,5;2\n1.000,5;2\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"row 3 has .1\.000\.5. where a number belongs"):
        read_number_rows(tmp_path / "blade.csv")
