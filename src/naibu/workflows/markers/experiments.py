"""Experiments as the verbs take them: folders, names of bundled datasets or objects, with the materials known beforehand."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from naibu import datasets
from naibu._version import __version__
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.units import kilopascals
from naibu.identification.from_markers.checks.marker_checks import check_markers
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.imaging.markers.tracking import FEWEST_COMMON
from naibu.io.experiment_folder.reader import META_FILE, read_experiment
from naibu.io.files.paths import require_usable_path

Source = str | os.PathLike[str] | Experiment
MOST_ELEMENTS = 100_000
RATIO_REFERENCE_KPA = 200.0  # stands for 1 where only ratios of moduli are sought


def load_experiment(source: Source) -> Experiment:
    """Return an experiment from a folder, or a bundled one by its name.

    Raises
    ------
    InputError
        Neither a folder with a ``meta.toml`` nor the name of a bundled dataset, or a folder that cannot be used.
    """
    if isinstance(source, Experiment):
        return source
    path, name = require_usable_path(source), str(source)
    if path.is_file():
        raise InputError(f"{path} is a file, but an experiment is a folder with a {META_FILE} in it; give the folder, {path.parent}")
    if path.exists():
        return read_experiment(path)
    if name in datasets.names():
        return datasets.load(name)
    close = difflib.get_close_matches(name, datasets.names(), n=1)
    hint = f"Did you mean {close[0]!r}? " if close else ""
    raise InputError(
        f"{name!r} is neither a folder with a {META_FILE} nor a bundled dataset. {hint}Bundled are {', '.join(datasets.names())}"
    )


def load_experiments(experiments: Sequence[Source] | Source) -> list[Experiment]:
    """Return experiments from folders or names of bundled datasets; one source may stand alone.

    Raises
    ------
    InputError
        Two experiments of one name, one loaded state twice, or a source that cannot be used.
    """
    sources = [experiments] if isinstance(experiments, str | os.PathLike | Experiment) else list(experiments)
    loaded = [load_experiment(e) for e in sources]
    names = [e.name for e in loaded]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{names.count(name)} experiments are called {name!r}; give each once, or rename a folder")
    _require_different(loaded)
    return loaded


def _require_different(experiments: Sequence[Experiment]) -> None:
    """Refuse positions that are there twice, under other names: they would count as two measurements, and narrow all intervals."""
    seen: dict[bytes, str] = {}
    for e in experiments:
        for state in e.loaded_states:
            if state.markers is None or len(state.markers.ids) < FEWEST_COMMON:
                continue  # what is too little to identify from is refused elsewhere
            label = f"{e.name}/{state.name}"
            first = seen.setdefault(state.markers.points.tobytes(), label)
            if first != label:
                raise InputError(f"{first} and {label} hold the same positions, which would count twice; give each measurement once")


def doubts_of_markers(experiment: Experiment) -> tuple[str, ...]:
    """Say what `naibu.identify` will doubt or refuse of an experiment, such as exchanged states; its folder can still be corrected."""
    try:
        return tuple(doubt.text for doubt in check_markers([experiment]))
    except InputError as error:
        return (f"naibu identify will refuse this: {error}",)


def require_loaded(experiment: Experiment, state: str) -> None:
    """Refuse a state that the experiment does not have, or that shows no load.

    Raises
    ------
    InputError
        There is no such state, or it is not loaded.
    """
    if not experiment.state(state).loaded:
        raise InputError(f"{experiment.name}/{state} is not loaded; loaded are {loaded_names(experiment)}")


def require_element_size(experiments: Sequence[Experiment], edge_mm: float) -> None:
    """Refuse elements of no size, elements larger than an object, and so many that no memory holds them; 0 stands for the default.

    Raises
    ------
    InputError
        Such a size.
    """
    if not (math.isfinite(edge_mm) and edge_mm >= 0.0):
        raise InputError(f"element_size_mm is {edge_mm:g} mm; give a positive length, or 0 for an eighth of the object's height")
    for e in experiments:
        if edge_mm > max(e.shape.size_mm):
            raise InputError(
                f"element_size_mm is {edge_mm:g} mm, but {e.name} measures {max(e.shape.size_mm):g} mm at most; give less, or 0 for an "
                "eighth of its height"
            )
        # one length after the other: the cube of a tiny edge is 0
        count = math.prod(size / edge_mm for size in e.shape.size_mm) if edge_mm > 0.0 else 0.0
        if count > MOST_ELEMENTS:
            raise InputError(
                f"element_size_mm of {edge_mm:g} mm makes {count:.3g} elements of {e.name}; at most {MOST_ELEMENTS} are solved"
            )


def loaded_names(experiment: Experiment) -> str:
    """Return the names of the loaded states, for messages."""
    return ", ".join(s.name for s in experiment.states[1:] if s.loaded) or "none"


def parse_known(known: Sequence[str]) -> KnownMaterials | None:
    """Read ``"hardness 5=222 kPa"`` (absolute) or ``"hardness 5"`` (sets the scale of ratios).

    Raises
    ------
    InputError
        A value that is not a modulus, a material given twice, or materials with and without a value mixed.
    """
    if not known:
        return None
    pairs = [(name.strip(), value.strip()) for name, _, value in (text.partition("=") for text in known)]
    names = [name for name, _ in pairs]
    for name in names:
        if not name or names.count(name) > 1:
            raise InputError(f"known names {name!r} {names.count(name)} times; write each material once, such as 'hardness 5=222 kPa'")
    without = [text for text in known if "=" not in text]
    if without and len(without) < len(known):
        raise InputError(f"known gives a modulus for some materials but none for {', '.join(without)}; give one for each")
    if len(without) > 1:
        raise InputError("without moduli only one material can set the scale; write for instance known='hardness 5=222 kPa'")
    if without:
        return KnownMaterials({names[0]: RATIO_REFERENCE_KPA}, scale_is_absolute=False)
    try:
        return KnownMaterials({name: kilopascals(value) for name, value in pairs})
    except InputError as error:
        raise InputError(f"known: {', '.join(repr(text) for text in known)}: {error}") from error


def provenance_of(
    experiments: Sequence[Experiment], known: Sequence[str], states: Mapping[str, Sequence[str]], settings: ModelSettings
) -> dict[str, Any]:
    """Return what a result came from: version, inputs and settings; two runs with the same provenance give the same result."""
    return {
        "naibu": __version__,
        "known": list(known),
        "states": {name: list(chosen) for name, chosen in states.items()},
        "settings": asdict(settings),
        "inputs": {e.name: dict(e.input_hashes) for e in experiments},
        "seed": "none: the search is deterministic",
    }
