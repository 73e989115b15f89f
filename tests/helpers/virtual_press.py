"""A small gel of two layers under a plate, whose parameters are known: quick to make, to identify and to predict."""

from __future__ import annotations

import copyreg
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import pytest

from naibu.core.experiment import Loading
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.io.tables.marker_tables import write_experiment_folder
from naibu.validation.specimens.marker_phantoms import Phantom, Scanner, box_experiment, phantom
from naibu.workflows.markers.identify import Identification

SIDE_MM = 60.0
TRUTH = {"soft: young_modulus": 100.0, "firm: young_modulus": 200.0, "soft: poisson_ratio": 0.48, "firm: poisson_ratio": 0.48}
KNOWN = ("firm=200 kPa",)
COARSE = ModelSettings(element_size_mm=20.0)
PLATEN_POSITIONS_MM = {"pressed": 50.0, "pressed_more": 46.0}
SCANNER = Scanner(placing_mm=0.1, shift_mm=5.0)


@dataclass(frozen=True)
class Press:
    """A virtual experiment with two loaded states as a folder, and what was identified from the first of them."""

    folder: Path
    results: Path
    identification: Identification


def read_only(values: dict[object, object]) -> MappingProxyType[object, object]:
    return MappingProxyType(values)


# so that one process of a run can make the press for the others
copyreg.pickle(MappingProxyType, lambda view: (read_only, (dict(view),)))


def virtual_press(seed: int = 1) -> Phantom:
    layers = [("soft", SIDE_MM / 2), ("firm", SIDE_MM / 2)]
    template = box_experiment("press", (SIDE_MM,) * 3, layers, Loading("plate"), PLATEN_POSITIONS_MM)
    return phantom(template, TRUTH, seed=seed, scanner=SCANNER, settings=ModelSettings(element_size_mm=15.0))


def stop_at(patch: pytest.MonkeyPatch, call: int) -> None:
    """Press Ctrl-C in the given evaluation of all trials on the mesh asked for."""
    evaluate = Matcher.evaluate
    calls: list[bool] = []

    def interrupted(self: Matcher, *arguments: object, **options: object) -> object:
        calls.append(self.load_cases[0].specimen.settings.element_size_mm == COARSE.element_size_mm)
        if calls[-1] and sum(calls) == call:
            raise KeyboardInterrupt
        return evaluate(self, *arguments, **options)  # type: ignore[arg-type]

    patch.setattr(Matcher, "evaluate", interrupted)


def write_press(folder: Path, made: Phantom, states: tuple[str, ...] = ("pressed",)) -> Path:
    """Write the states as a user's folder."""
    e = made.experiment
    return write_experiment_folder(
        folder,
        e.initial,
        {s: e.state(s).markers for s in states},
        title="A virtual press",
        shape=e.shape,
        loading=e.loading,
        layers=e.layers,
        stated_mm={s: PLATEN_POSITIONS_MM[s] for s in states},
        spacing_mm=e.nominal_spacing_mm,
        xy_step_mm=e.xy_step_mm,
        z_step_mm=e.z_step_mm,
    )
