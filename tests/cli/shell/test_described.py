"""What options of several parts say, read from their texts."""

from __future__ import annotations

import pytest

from naibu.cli.shell.described import labels_of
from naibu.core.errors import InputError


def test_names_and_labels_are_read_in_either_order() -> None:
    assert labels_of(["gel=1", "2=bone", "soft = part = 3", " 4 = 2nd layer"]) == {1: "gel", 2: "bone", 3: "soft = part", 4: "2nd layer"}
    assert labels_of(["7=1"]) == {1: "7"}  # two numbers: the label stands behind


@pytest.mark.parametrize("texts", [["gel"], ["gel=soft"], ["=1"], ["1="], ["gel=1", "1=pad"], ["gel=1", "2=gel"]])
def test_other_texts_are_refused(texts: list[str]) -> None:
    with pytest.raises(InputError, match="zone_name"):
        labels_of(texts)
