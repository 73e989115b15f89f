"""Options shared by several verbs: those of a pair of scans, and the description of an object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token

from naibu.cli.shell.help_texts import flowing
from naibu.core.errors import InputError

# what needs numpy is imported where it is used: --help answers at once, and doctor also runs where numpy itself is broken
if TYPE_CHECKING:
    from naibu.core.experiment import Layer, Loading

Flag = Annotated[bool, Parameter(negative=())]
# the options that many verbs have, with their short names
Out = Annotated[Path, Parameter(name=("--out", "-o"))]
Overwrite = Annotated[bool, Parameter(name=("--overwrite", "-f"), negative=())]
Known = Annotated[list[str] | None, Parameter(name=("--known", "-k"))]
Layers = Annotated[list[str] | None, Parameter(name=("--layer", "-l"))]


def _whole(hint: object, tokens: Sequence[Token]) -> int:
    # the parser's own conversion takes 2.5 for 2
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{tokens[0].value!r} is not a whole number.") from None


Whole = Annotated[int, Parameter(converter=_whole)]


@Parameter(name="*")
@flowing
@dataclass(frozen=True)
class PairOptions:
    """Options for a pair of scans.

    Parameters
    ----------
    mask
        Volume on the grid of the reference scan, nonzero inside the object; by default it is segmented.
    deformed_mask
        The same on the grid of the deformed scan; the search of volume correlation starts from it.
    spacing_mm
        Voxel spacing along x, y, z, mm, for files that do not state it.
    truth
        Known displacement (.mha, .nrrd) to compare with.
    check_points
        Two tables of points, reference and deformed, to compare with.
    """

    mask: Annotated[Path | None, Parameter(name=("--mask", "-m"))] = None
    deformed_mask: Path | None = None
    spacing_mm: tuple[float, float, float] | None = None
    truth: Path | None = None
    check_points: tuple[Path, Path] | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """As `naibu.workflows.measurement.sense.read_pair` takes them."""
        return {
            "mask": self.mask,
            "deformed_mask": self.deformed_mask,
            "spacing_mm": self.spacing_mm,
            "truth": self.truth,
            "check_points": self.check_points,
        }


@Parameter(name="*")
@flowing
@dataclass(frozen=True)
class WorkerOptions:
    """Where independent parts of a computation run.

    Parameters
    ----------
    workers
        Processes that share the independent parts; 0 takes as many as cores and free memory allow. Results do not depend on it.
    cluster
        Address of the scheduler of a Dask cluster, such as tcp://host:8786, which computes them instead.
    """

    workers: Whole = 1
    cluster: str | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """As workflows take them."""
        return {"workers": self.workers, "cluster": self.cluster}


@Parameter(name="*")
@flowing
@dataclass(frozen=True)
class ObjectOptions:
    """Shape, layers and loading of an object.

    Parameters
    ----------
    shape
        Outer shape of the object.
    loading
        What loads it.
    bar_width_mm
        Width of the bar.
    bar_axis
        Horizontal axis along which the bar lies, or along which the side plates press. Required for both.
    layer
        A layer of one material, 'NAME=FROM..TO' with heights from the base in mm. May be repeated.
    stated_mm
        Height of the plate or bar in a state, or distance between the side plates, 'STATE=HEIGHT' in mm. May be repeated.
    vertical
        Direction away from the base in the axes of the tables or scans, if it is not z: 'y', '-z' (written --vertical=-z) or three numbers
        such as '0.1,0.3,0.95'; or 'found', from the lattice of the markers or the direction of compression. Markers are turned accordingly.
    """

    shape: Literal["box", "half_ellipsoid", "cylinder", "hemisphere"] = "box"
    loading: Literal["plate", "bar", "side_plates"] = "plate"
    bar_width_mm: float | None = None
    bar_axis: Literal["x", "y"] | None = None
    layer: Layers = None
    stated_mm: list[str] | None = None
    vertical: str | None = None

    def described(self, size_mm: tuple[float, float, float]) -> dict[str, Any]:
        """Return shape, loading, layers, stated_mm and vertical, as `naibu.workflows.markers.import_tables.import_tables` takes them.

        Raises
        ------
        InputError
            A layer, a height or a direction of another form; what describes another loading, or does not describe this one.
        """
        from naibu.core.experiment import Shape

        return {
            "shape": Shape(self.shape, size_mm),
            "loading": self._loading(),
            "layers": layers_of(self.layer or ()),
            "stated_mm": heights_of(self.stated_mm or ()),
            "vertical": direction_of(self.vertical),
        }

    def _loading(self) -> Loading:
        from naibu.core.experiment import Loading

        if self.bar_width_mm is not None and self.loading != "bar":
            raise InputError(f"--bar-width-mm is given, but --loading is {self.loading}; give --loading bar, or leave the width out")
        if self.loading == "plate":
            if self.bar_axis is not None:
                raise InputError("--bar-axis is given, but --loading is plate; give --loading bar or side_plates, or leave the axis out")
            return Loading("plate")
        if self.loading == "bar" and self.bar_width_mm is None:
            raise InputError("--bar-width-mm is missing: give the width of the bar, for example --bar-width-mm 13")
        if self.bar_axis is None:
            does = "the bar lies" if self.loading == "bar" else "the side plates press"
            raise InputError(f"--bar-axis is missing: name the horizontal axis along which {does}, --bar-axis x or --bar-axis y")
        return Loading(self.loading, self.bar_width_mm, self.bar_axis)


def layers_of(texts: Sequence[str]) -> tuple[Layer, ...]:
    """Return layers from texts such as ``hardness 0=0..30``, heights from the base in mm.

    Raises
    ------
    InputError
        A text of another form.
    """
    from naibu.core.arrays import LENGTHS_MM
    from naibu.core.experiment import Layer

    layers = []
    for text in texts:
        material, _, span = text.rpartition("=")
        low, dots, high = span.partition("..")
        try:
            if not (material.strip() and dots):
                raise ValueError
            slab = Layer(material.strip(), float(low), float(high))
            if not 0.0 <= slab.from_base_mm < slab.to_base_mm <= LENGTHS_MM[1]:
                raise ValueError
        except ValueError:
            raise InputError(
                f"--layer {text!r} must be NAME=FROM..TO with growing heights from the base in mm, such as 'hardness 0=0..30'"
            ) from None
        layers.append(slab)
    return tuple(layers)


def labels_of(texts: Sequence[str]) -> dict[int, str]:
    """Return names by label from texts such as ``gel=1``, or ``1=gel``; where both sides are numbers, the second is the label.

    Raises
    ------
    InputError
        A text of another form, or a name or label twice.
    """
    names: dict[int, str] = {}
    for text in texts:
        name, _, label = text.rpartition("=")
        if name.strip().isdecimal() and not label.strip().isdecimal():  # no name but of digits has such a label
            name, label = label, name
        if not name.strip() or not label.strip().isdecimal() or len(label) > 9:
            raise InputError(f"zone_name {text!r} must give a name and a label, which is a whole number, such as 'gel=1'")
        if int(label) in names or name.strip() in names.values():
            raise InputError(f"zone_name {text!r} names a label, or has a name, that another zone_name has; give each label one name")
        names[int(label)] = name.strip()
    return names


def heights_of(texts: Sequence[str]) -> dict[str, float]:
    """Return heights by state from texts such as ``pressed=45``, mm.

    Raises
    ------
    InputError
        A text of another form.
    """
    from naibu.core.arrays import LENGTHS_MM, require_within

    heights = {}
    for text in texts:
        state, _, height = text.rpartition("=")
        try:
            if not state.strip():
                raise ValueError
            value = float(height)
        except ValueError:
            raise InputError(f"--stated-mm {text!r} must be STATE=HEIGHT in mm, such as 'pressed=45'") from None
        if state.strip() in heights:
            raise InputError(f"--stated-mm names the state {state.strip()!r} twice; give one height for each state")
        heights[state.strip()] = require_within(f"--stated-mm {text!r}: the height", value, *LENGTHS_MM, "mm")
    return heights


def direction_of(text: str | None) -> tuple[float, ...] | Literal["found"] | None:
    """Return a direction from texts such as ``y``, ``-z`` or ``0.1,0.3,0.95``, or the word ``found``.

    Raises
    ------
    InputError
        A text of another form.
    """
    if text is None:
        return None
    if text == "found":
        return "found"
    axis = text.lstrip("+-")
    if axis in ("x", "y", "z"):
        return tuple((-1.0 if text.startswith("-") else 1.0) * (axis == name) for name in "xyz")
    try:
        x, y, z = (float(part) for part in text.replace(" ", ",").split(",") if part)
        if not 0.0 < math.hypot(x, y, z) < math.inf:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--vertical {text!r} must be 'found', an axis such as 'y' or '-z', or three numbers, not all zero, such as '0.1,0.3,0.95'"
        ) from None
    return x, y, z


def require_left_out(reason: str, **given: bool) -> None:
    """Refuse options that do not belong to the kind of data: they would be ignored without a word."""
    for name, there in given.items():
        if there:
            raise InputError(f"`{name}` {reason}; leave it out")
