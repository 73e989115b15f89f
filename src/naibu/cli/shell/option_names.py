"""Messages of the library name arguments of functions; the command line shows them as the options and operands of the running verb."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from cyclopts import App

# arguments of library functions that a verb offers under another name
OTHER_NAMES: Mapping[str, Mapping[str, str]] = {
    "identify": {"states": "state", "zone_names": "zone_name", "each_cell": "cell_map"},
    "predict": {"platen_position_mm": "height_mm", "held": "hold", "moved": "move", "field": "experiment"},
    "design": {"zone_names": "zone_name", "layers": "layer", "expected": "expect", "pushes": "push"},
    "compare": {"candidates": "law"},
    "compare-methods": {"methods": "method"},
    "import": {"source": "initial"},
}


def in_options(message: str, app: App, tokens: Sequence[str]) -> str:
    """Return a message with the names of arguments replaced by those of the options of the verb that `tokens` call.

    A name of several words, such as ``height_mm``, is replaced wherever it stands alone; a name that is also an ordinary word only in
    backticks, before an equals sign, or as the subject at the beginning of the message.

    Parameters
    ----------
    message : str
        Text of an error of the library.
    app : App
        The program.
    tokens : sequence of str
        Arguments of the command line.
    """
    chain, apps, _ = app.parse_commands(list(tokens))
    if not chain or chain[0].startswith("-"):
        return message
    for name, option in _options(apps[-1], chain[0]).items():
        word = re.escape(name)
        patterns = [rf"`{word}`", rf"(?<![\w.\-/'\"`]){word}(?=\s?=)", rf"^{word}(?=:| (?:must|is|are|has|have|holds|gives|names|needs)\b)"]
        if "_" in name:
            patterns.append(rf"(?<![\w.\-/'\"`\[]){word}(?![\w\-/'\"`(]|\.\w)")
        message = re.sub("|".join(patterns), option, message)
    message = re.sub(r"--([\w\-]+)=False\b", r"--no-\1", message)  # a flag that is on by default
    return re.sub(r"(?<=for example )\(([-\d., ]+)\)", lambda found: found[1].replace(",", ""), message)  # several values of an option


def usage_error(message: str, app: App, tokens: Sequence[str]) -> str:
    """Return a message about the form of a command, with operands by their names and the help to look at.

    Parameters
    ----------
    message : str
        Text of an error of the parser.
    app : App
        The program.
    tokens : sequence of str
        Arguments of the command line.
    """
    chain, apps, _ = app.parse_commands(list(tokens))
    if not chain or chain[0].startswith("-"):
        return f"{message} See naibu --help."
    lacking = re.fullmatch(r'Command "\S+" parameter (--\S+) requires an argument\.', message)
    if lacking:
        operands = {a.names[0]: _operand(a.names[0]) for a in apps[-1].assemble_argument_collection() if a.index is not None}
        given = lacking[1] in tokens
        message = f"{lacking[1]} needs a value." if given else f"naibu {chain[0]} needs {operands.get(lacking[1], lacking[1])}."
    return f"{message} See naibu {chain[0]} --help."


def _operand(option: str) -> str:
    return option[2:].replace("-", "_").upper()


def _options(verb: App, name: str) -> dict[str, str]:
    """Spelling of every argument on the command line; the longest names come first."""
    spelled = {}
    for argument in verb.assemble_argument_collection():
        if not argument.names[0].startswith("--"):
            continue
        spelled[argument.field_info.name] = argument.names[0] if argument.index is None else _operand(argument.names[0])
    spelled |= {other: spelled[own] for other, own in OTHER_NAMES.get(name, {}).items()}
    return dict(sorted(spelled.items(), key=lambda item: -len(item[0])))
