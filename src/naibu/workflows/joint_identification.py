"""Identify moduli from experiments with markers and from displacement fields together: what both kinds name is one parameter."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.joint_estimate import JointEstimate, NormalEstimate, joint_estimate
from naibu.io.files.atomic import write_atomically
from naibu.viewer.cards import Card, cards_html
from naibu.viewer.notebook import WrittenResult
from naibu.viewer.page_frame import page_html
from naibu.viewer.tables import Cell, Table, table_html
from naibu.workflows.fields.block_mesh import labelled_object, names_of_labels
from naibu.workflows.fields.identify_fields import FieldIdentification, identify_fields
from naibu.workflows.fields.known_zones import KnownZones, parse_known_zones
from naibu.workflows.joint_model import JointModel, joint_model, told_by_fields, told_by_markers
from naibu.workflows.markers.experiments import Source, load_experiments, parse_known
from naibu.workflows.markers.identify import Identification, identify, require_states
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.results.result_folder import MODEL_FILE, write_joint_model

FILES = (MODEL_FILE, "joint.json", "report.html")
MARKERS, FIELDS = "markers", "fields"  # folders of either kind
WIDTH = 1.959964  # standard deviations of a 95 % interval
_PLACES = (("markers", 1), ("fields", 4), ("both", 7))  # of estimate and interval in a row of the table


@dataclass(frozen=True, slots=True, eq=False)
class JointIdentification(WrittenResult):
    """What `identify_jointly` returns.

    Attributes
    ----------
    markers : Identification
        From the experiments with markers alone.
    fields : FieldIdentification
        From the displacement fields alone.
    joint : JointEstimate
        Both: logarithms of Young's moduli, kPa or ratios, and of ``1 - 2 nu``.
    model : JointModel
        Models of both kinds with these moduli, which predict.
    table : Table
        Moduli from either kind and from both, with 95 % intervals.
    notes : tuple of str
        What is shared, and whether both kinds agree, in words.
    files : tuple of Path
        What was written, beside the folders of either kind.
    """

    markers: Identification
    fields: FieldIdentification
    joint: JointEstimate
    model: JointModel
    table: Table
    notes: tuple[str, ...]
    files: tuple[Path, ...] = ()

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a parameter: its name, and what markers, fields and both tell, with 95 % intervals."""
        columns = ("parameter", *(f"{kind}{end}" for kind in ("markers", "fields", "both") for end in ("", "_lower", "_upper")))
        return tuple(dict(zip(columns, row, strict=True)) for row in self.table.rows)

    @property
    def usable(self) -> bool:
        """Whether the models explain both kinds of data, and these do not contradict each other."""
        judged = self.fields.estimate.verdict
        return self.markers.verdict.ok and (judged is None or judged.ok) and not self.model.doubts


@no_empty_folders()
def identify_jointly(
    experiments: Sequence[Source],
    fields: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    known: Sequence[str] = (),
    settings: ModelSettings | None = None,
    states: Mapping[str, Sequence[str]] | None = None,
    mask: str | os.PathLike[str] | None = None,
    zones: str | os.PathLike[str] | None = None,
    zone_names: Mapping[int, str] | None = None,
    loaded: Sequence[str] = (),
    unit: str | None = None,
    spacing_mm: Sequence[float] | None = None,
    node_spacing: Sequence[float] | None = None,
    check_components: bool = True,
    element_size_mm: float = 0.0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> JointIdentification:
    """Identify moduli from experiments with markers and from displacement fields, and join what both tell.

    Each kind is identified by itself, with its own boundary conditions. Young's modulus and Poisson's ratio of a zone of the fields and of
    a material of the experiments are one parameter where their names are the same; about the optima, the joint estimate is that of maximum
    likelihood (`naibu.identification.joint_estimate`). Both must have one scale: kPa, or multiples of the same material.

    Parameters
    ----------
    experiments, settings, states
        As for `naibu.workflows.identify`.
    fields, mask, zones, zone_names, loaded, unit, spacing_mm, node_spacing, check_components
        As for `naibu.workflows.identify_fields`.
    out : path-like
        Folder for ``model.json``, ``joint.json`` and ``report.html``, and for the results of either kind in ``markers`` and ``fields``.
    known : sequence of str
        Materials and zones, each in one kind of data at least.
    element_size_mm : float
        Of the cells in fields; 0 chooses it.
    overwrite : bool
        Whether these files may be there already.
    progress : callable, optional
        Gets a report after every step.

    Raises
    ------
    InputError
        Data that cannot be used, a known name in neither kind, two scales, or no modulus that both kinds tell.
    """
    folder = output_folder(out, FILES, overwrite=overwrite)
    loaded_experiments = load_experiments(list(experiments))
    inside, labels = labelled_object(mask, zones)
    materials = {m for e in loaded_experiments for m in e.materials}
    zones_there = list(names_of_labels(labels, inside, zone_names or {}).values())
    require_states(loaded_experiments, states or {})
    of_markers, of_fields = _divided(known, materials, set(zones_there))
    _require_one_scale(parse_known(of_markers), parse_known_zones(of_fields, zones_there))
    if not materials & set(zones_there):
        raise InputError(
            f"no material of the experiments ({', '.join(sorted(materials))}) has the name of a zone of the fields "
            f"({', '.join(sorted(zones_there))}), so that nothing is shared; name zones after materials with `zone_names`"
        )
    from_fields = identify_fields(
        fields, mask=mask, zones=zones, zone_names=zone_names, known=of_fields, loaded=loaded, unit=unit, spacing_mm=spacing_mm,
        node_spacing=node_spacing, check_components=check_components, element_size_mm=element_size_mm, out=folder / FIELDS,
        overwrite=overwrite, progress=progress,
    )  # fmt: skip
    from_markers = identify(
        loaded_experiments, known=of_markers, settings=settings, states=states, out=folder / MARKERS, overwrite=overwrite, progress=progress
    )
    parts = (told_by_markers(from_markers.model), told_by_fields(from_fields.estimate))
    joint = joint_estimate(parts)
    bounds = from_fields.estimate.intervals()[0].tolist()
    of_fields_alone = {young_modulus(name): (low, high) for name, (low, high) in zip(from_fields.estimate.zones.names, bounds, strict=True)}
    table = table_of_moduli(parts, joint, of_fields_alone, relative=from_fields.relative)
    model = joint_model(from_markers.calibration, from_markers.model, from_fields.body, from_fields.estimate, joint)
    notes = (*_in_words(joint, parts), *(f"Doubtful: {doubt}." for doubt in model.doubts), *model.notes)
    result = JointIdentification(from_markers, from_fields, joint, model, table, notes)
    return replace(result, files=written_together(folder, FILES, lambda at: _written(at, result)))


def _divided(known: Sequence[str], materials: set[str], zones: set[str]) -> tuple[list[str], list[str]]:
    """Return what is known of materials of experiments, and of zones of fields."""
    names = [text.partition("=")[0].strip() for text in known]
    for name in names:
        if name not in materials | zones:
            raise InputError(
                f"known names {name!r}, which is neither a material of the experiments ({', '.join(sorted(materials))}) nor a zone of the "
                f"fields ({', '.join(sorted(zones))})"
            )
    both = list(zip(names, known, strict=True))
    return [text for name, text in both if name in materials], [text for name, text in both if name in zones]


def _require_one_scale(materials: KnownMaterials | None, zones: KnownZones) -> None:
    absolute = materials is not None and materials.scale_is_absolute
    if absolute == (not zones.relative) and (absolute or (materials is not None and set(materials.young_moduli) == set(zones.values))):
        return
    kinds = ["in kPa" if kpa else "multiples of a known material" for kpa in (absolute, not zones.relative)]
    raise InputError(
        f"moduli from the experiments are {kinds[0]}, those from the fields {kinds[1]}: give `known` a modulus for a material of the "
        "experiments and for a zone of the fields, or name one that both have"
    )


def table_of_moduli(
    parts: Sequence[NormalEstimate], joint: JointEstimate, of_fields: Mapping[str, tuple[float, float]] | None = None, *, relative: bool
) -> Table:
    """Return the table of parameters: from markers, from fields, and from both, with 95 % intervals.

    `of_fields` are the bounds that fields alone gave where these are not those of a normal distribution.
    """
    rows: list[tuple[Cell, ...]] = []
    for name in joint.together.names:
        cells: list[Cell] = [_readable(name)]
        for i, part in enumerate((*parts, joint.together)):
            if name in part.names and np.isfinite(part.standard_deviation(name)):
                told = _physical(name, part.value(name) + part.standard_deviation(name) * np.array([0.0, -WIDTH, WIDTH])).tolist()
                cells += [told[0], *((of_fields or {}).get(name, told[1:]) if i == 1 else told[1:])]
            else:
                cells += [None] * 3
        rows.append(tuple(cells))
    columns = ("parameter", *(c for kind in ("markers", "fields", "both") for c in (kind, "95 % from", "to")))
    unit = "multiples of the known material" if relative else "kPa"
    return Table("Moduli", columns, tuple(rows), note=f"Young's moduli in {unit}.")


def _readable(name: str) -> str:
    return name.replace(": ", ", ").replace("_", " ").replace("young", "Young's").replace("poisson", "Poisson's")


def _physical(name: str, inner: FloatArray) -> FloatArray:
    values = np.exp(inner)
    return values if name.endswith(young_modulus("")) else np.sort(0.5 * (1.0 - values))[[1, 0, 2]]


def _in_words(joint: JointEstimate, parts: Sequence[NormalEstimate]) -> tuple[str, ...]:
    shared = "; ".join(_readable(name) for name in joint.shared)
    measure = f"chi squared {joint.chi_squared:.3g} with {joint.degrees_of_freedom} degrees of freedom"
    if not joint.contradicted:
        return (f"Markers and fields agree ({measure}) on what both tell: {shared}.",)
    apart = {n: abs(parts[0].value(n) - parts[1].value(n)) / math.hypot(*(p.standard_deviation(n) for p in parts)) for n in joint.shared}
    worst = max(apart, key=lambda n: apart[n])
    named = _readable(worst)
    return (
        f"Markers and fields contradict each other ({measure}), most about {named}: {apart[worst]:.2g} standard deviations. Intervals of "
        f"what both tell together are {joint.widened:.2g} times as wide for it; question names, known values and loads.",
    )


def _cards(result: JointIdentification) -> tuple[Card, ...]:
    """Return what both kinds of data tell of every parameter that both or either determines."""
    absolute = result.model.markers.known_materials.scale_is_absolute
    cards = []
    for name, *values in result.table.rows:
        estimate, low, high = values[6:]
        if isinstance(estimate, float):
            unit = " kPa" if absolute and str(name).endswith("modulus") else ""
            cards.append(Card(str(name), f"{estimate:.3g}{unit}", f"{low:.3g} to {high:.3g} (95 %), from markers and fields"))
    return tuple(cards)


def _written(folder: Path, result: JointIdentification) -> list[Path]:
    table = result.table
    numbers = {
        "naibu": __version__,
        "usable": result.usable,
        "shared": list(result.joint.shared),
        "chi_squared": result.joint.chi_squared,
        "degrees_of_freedom": result.joint.degrees_of_freedom,
        "widened": result.joint.widened,
        "moduli": [
            {"parameter": row[0]} | {kind: dict(zip(("estimate", "from", "to"), row[i : i + 3], strict=True)) for kind, i in _PLACES}
            for row in table.rows
        ],
        "in_words": list(result.notes),
    }
    warning = "" if result.usable else "<p><strong>A model does not explain the data: not to be used.</strong></p>"
    links = f'<p><a href="{MARKERS}/report.html">Results from markers</a>, <a href="{FIELDS}/report.html">results from fields</a></p>'
    main = "".join(f"<p>{escape(line)}</p>" for line in result.notes) + table_html(table) + links
    header = cards_html(_cards(result)) + warning
    page = page_html("Moduli from markers and displacement fields", header, main, f"naibu {escape(__version__)}")
    files = [
        write_joint_model(folder, result.model),
        write_atomically(folder / "joint.json", json.dumps(numbers, indent=1, ensure_ascii=False) + "\n"),
    ]
    return [write_atomically(folder / "report.html", page), *files]
