"""Commands of the live page: what is read, and what is refused."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.viewer.live.commands import LARGEST, VOCABULARY, LiveCommand, read_command


def test_commands_are_read() -> None:
    assert read_command('{"type": "next"}') == LiveCommand("next")
    assert read_command('{"type": "move", "at": [1, 2.5, -3]}').vector == (1.0, 2.5, -3.0)
    assert read_command('{"type": "turn", "by": [0, 0.5, -3]}').vector == (0.0, 0.5, -3.0)
    assert len(read_command('{"type": "cut", "edges": [[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 0]]]}').edges) == 2
    assert read_command('{"type": "grip", "node": 7}').number == 7
    assert read_command('{"type": "pause", "on": true}').switch
    assert read_command('{"type": "tool", "name": "sphere"}').name == "sphere"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "JSON object"),
        ("[" * 5000, "JSON object"),
        ("[]", "type is one of"),
        ('{"type": "format disk"}', "type is one of"),
        ('{"type": ["next"]}', "type is one of"),
        ('{"type": "move"}', "three numbers"),
        ('{"type": "move", "at": [1, 2]}', "three numbers"),
        ('{"type": "move", "at": [1, 2, NaN]}', "finite"),
        ('{"type": "move", "at": [1, 2, 1e400]}', "finite"),
        ('{"type": "move", "at": [1, 2, true]}', "finite"),
        ('{"type": "pull", "at": [1, 2, 1e9]}', "at most"),
        ('{"type": "turn", "by": [0, 4, 0]}', "at most 3 rad"),
        ('{"type": "turn", "at": [0, 1, 0]}', "three numbers"),
        ('{"type": "grip", "node": -1}', "not negative"),
        ('{"type": "grip", "node": 1.5}', "whole number"),
        ('{"type": "grip", "node": true}', "whole number"),
        ('{"type": "pause", "on": 1}', "true or false"),
        ('{"type": "tool", "name": 3}', "text"),
        (json.dumps({"type": "tool", "name": "x" * 100}), "at most 40"),
        ('{"type": "cut", "edges": [[[0, 0, 0], [1, 0, 0]]]}', "2 to 200 edges"),
        ('{"type": "cut", "edges": [[[0, 0, 0], [1, 0, 0]], [[0, 1, 0]]]}', "same number of vertices"),
        ('{"type": "cut", "edges": [[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, "a"]]]}', "finite"),
    ],
)
def test_others_are_refused_with_what_is_wrong(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_command(text)


@settings(max_examples=30, deadline=None)
@given(
    st.recursive(st.none() | st.booleans() | st.floats() | st.integers() | st.text(), lambda c: st.lists(c) | st.dictionaries(st.text(), c))
)
def test_nothing_else_ends_in_another_error(value: object) -> None:
    for kind in VOCABULARY:
        try:
            found = read_command(json.dumps({"type": kind, "at": value, "node": value, "name": value, "on": value, "edges": value}))
        except InputError:
            continue
        assert all(abs(v) <= LARGEST for v in found.vector)
