"""Arguments of library functions in messages become the options of the verb that runs."""

from __future__ import annotations

import pytest
from cyclopts import CycloptsError

from naibu.cli import app
from naibu.cli.shell.option_names import OTHER_NAMES, in_options, usage_error

SAID = {
    "predict": [
        (
            "height_mm and heights_from_markers exclude each other; give one",
            "--height-mm and --heights-from-markers exclude each other; give one",
        ),
        ("platen_position_mm must be positive, not -3", "--height-mm must be positive, not -3"),
        ("press has 2 loaded states; choose one with `state`", "press has 2 loaded states; choose one with --state"),
        ("folder/height_mm.csv: the state is unknown", "folder/height_mm.csv: the state is unknown"),
        ("`model` must be a file", "MODEL must be a file"),
    ],
    "identify": [
        ("known names 'hard' 2 times", "--known names 'hard' 2 times"),
        ("known='x': no modulus", "--known='x': no modulus"),
        ("states of 'cube' are chosen with `states`", "states of 'cube' are chosen with --state"),
        ("element_size_mm=-3: must be positive", "--element-size-mm=-3: must be positive"),
        ("the material is not known: is it new?", "the material is not known: is it new?"),
        ("if it is right, give check_components=False", "if it is right, give --no-check-components"),
    ],
    "track": [
        ("mask is empty", "--mask is empty"),
        ("give spacing_mm, for example (0.8, 0.8, 2.0)", "give --spacing-mm, for example 0.8 0.8 2.0"),
        ("the mask is empty", "the mask is empty"),
        ("stated_mm gives no height", "--stated-mm gives no height"),
        ("scans must be at least two", "SCANS must be at least two"),
    ],
}


@pytest.mark.parametrize("verb", SAID)
def test_messages_name_the_options_of_the_verb(verb: str) -> None:
    for text, shown in SAID[verb]:
        assert in_options(text, app, [verb, "somewhere"]) == shown


def test_without_a_verb_a_message_stays() -> None:
    assert in_options("height_mm must be positive", app, ["nonsense"]) == "height_mm must be positive"
    assert in_options("height_mm must be positive", app, ["--help"]) == "height_mm must be positive"


def test_other_names_stand_for_options_there_are() -> None:
    for verb, names in OTHER_NAMES.items():
        options = {a.field_info.name for a in app[verb].assemble_argument_collection()}
        assert set(names.values()) <= options, verb


@pytest.mark.parametrize(
    ("tokens", "shown"),
    [
        (["sense", "a.mha"], "naibu sense needs DEFORMED. See naibu sense --help."),
        (["track-sequence", "a.tif", "--pixel-mm", "1"], "naibu track-sequence needs --diameter-mm. See naibu track-sequence --help."),
        (["identify", "--law"], "--law needs a value. See naibu identify --help."),
        (["sense", "a.mha", "b.mha", "--methode"], "Unknown option: --methode. Did you mean --method? See naibu sense --help."),
    ],
)
def test_usage_errors_name_operands_and_the_help_of_the_verb(tokens: list[str], shown: str) -> None:
    with pytest.raises(CycloptsError) as refused:
        app(tokens, exit_on_error=False, print_error=False)
    assert usage_error(" ".join(str(refused.value).split()), app, tokens) == shown


def test_an_unknown_verb_leads_to_the_list_of_verbs() -> None:
    assert usage_error('Unknown command "simulte".', app, ["simulte"]) == 'Unknown command "simulte". See naibu --help.'
