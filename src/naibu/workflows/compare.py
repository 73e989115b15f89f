"""Compare laws, contacts and joints: calibrate each candidate model, and predict each experiment from the others."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from naibu.core.errors import InputError
from naibu.identification.from_markers.specimen_model import ModelSettings
from naibu.identification.prediction.cross_validation import ModelRow, compare_models
from naibu.workflows.experiments import Source, load_experiments, parse_known, provenance_of
from naibu.workflows.result_folder import read_comparison, result_folder, write_comparison

Progress = Callable[[str, int, float], None]


def compare(
    experiments: Sequence[Source] | Source,
    *,
    candidates: Sequence[ModelSettings],
    known: Sequence[str] = (),
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> list[ModelRow]:
    """Calibrate several models on the same experiments, and predict each experiment from the others with each of them.

    Parameters
    ----------
    experiments : sequence of path, str or Experiment
        As for `identify`.
    candidates : sequence of ModelSettings
        Laws, contacts and joints to compare.
    known : sequence of str
        As for `identify`.
    out : path, optional
        Folder for ``comparison.json``, written anew after every candidate; candidates that it holds already, of the same inputs, are not
        repeated.
    progress : callable, optional
        ``progress(stage, iteration, objective)``.

    Returns
    -------
    list of ModelRow
        One for each candidate, in their order.

    Raises
    ------
    InputError
        Unusable input, or no candidate.
    """
    if not candidates:
        raise InputError("no model is given to compare; name at least one law or contact")
    loaded = load_experiments(experiments)
    known_materials = parse_known(known)
    folder = None if out is None else result_folder(out)
    rows: list[ModelRow] = []
    for settings in candidates:
        provenance = provenance_of(loaded, known, {}, settings)
        row = read_comparison(folder, provenance) if folder is not None else None
        if row is None:
            told = _stage(progress, settings)
            row = compare_models(loaded, [settings], known_materials=known_materials, callback=told)[0]
            if folder is not None:
                write_comparison(folder, provenance, row)
        rows.append(row)
    return rows


def _stage(progress: Progress | None, settings: ModelSettings) -> Callable[[str, int, float], None]:
    """Report the steps of one candidate under its name."""

    def tell(left: str, iteration: int, objective: float) -> None:
        if progress is not None:
            without = "" if left == "none" else f" without {left}"
            progress(f"{settings.law}, {settings.contact}, {settings.joined}{without}", iteration, objective)

    return tell
