"""Experiment: an object with markers inside, measured in its reference configuration and in one or more loaded states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from naibu.core.errors import InputError
from naibu.core.markers import Markers

Axis = Literal["x", "y", "z"]
LoadingKind = Literal["plate", "bar", "side_plates", "cylinder"]
ShapeKind = Literal["box", "half_ellipsoid", "cylinder", "hemisphere"]


@dataclass(frozen=True, slots=True)
class Shape:
    """Outer shape of the object in its reference configuration.

    Attributes
    ----------
    kind : str
        ``"box"``, ``"half_ellipsoid"``, ``"cylinder"`` or ``"hemisphere"``.
    size_mm : tuple of float
        Its extent along x, y, z; of a half ellipsoid without the straight-sided part below it.
    straight_base_mm : float, optional
        Height of a straight-sided part below a half ellipsoid; None where nobody states it.
    """

    kind: ShapeKind
    size_mm: tuple[float, float, float]
    straight_base_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Layer:
    """A horizontal slab of one material, heights measured from the base, mm.

    `batch` names what was mixed and cured together, where that is known: the same material differs in stiffness from batch to batch.
    """

    material: str
    from_base_mm: float
    to_base_mm: float
    batch: str = ""

    @property
    def region(self) -> str:
        """Name of the material in its batch."""
        return f"{self.material}, batch {self.batch}" if self.batch else self.material


@dataclass(frozen=True, slots=True)
class Loading:
    """How the object is pressed.

    Attributes
    ----------
    kind : str
        ``"plate"``: a rigid plate covers the top. ``"bar"``: a rigid bar of `bar_width_mm` lies across the whole top along `bar_axis`.
        ``"side_plates"``: two upright plates move towards each other along `bar_axis`.
        ``"cylinder"``: an upright cylinder of diameter `bar_width_mm` stands on the middle of the top.
    bar_width_mm : float or None
        Width of the bar's face, or diameter of the cylinder.
    bar_axis : str
        Direction along which the bar lies, or along which side plates press: ``"x"``, ``"y"`` or, where z is not up, ``"z"``.
    assumed : tuple of str
        Assumptions about what the file does not state, in words for the user; empty when there are none.
    """

    kind: LoadingKind
    bar_width_mm: float | None = None
    bar_axis: Axis = "y"
    counter_material: str = "acrylic"
    base_material: str = "table"
    assumed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One measured state.

    Attributes
    ----------
    name : str
        Name of the state, also of its file.
    markers : Markers or None
        None where the positions are withheld.
    stated_mm : float or None
        Nominal height of the plate or bar above the base, or distance of the side plates; None in the reference configuration or when not
        stated.
    estimated_mm : float or None
        The same, as estimated beforehand from the data by whoever wrote the file.
    what : str
        What the state shows, in words.
    loaded : bool
        False for a state without load: the reference configuration, and any measured before a second loading or after unloading.
    """

    name: str
    markers: Markers | None
    stated_mm: float | None = None
    estimated_mm: float | None = None
    what: str = ""
    loaded: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """An object, its loading, and its measured states; the first state is the reference configuration.

    Attributes
    ----------
    name, title, source : str
        Short name (that of the folder), description, and where the numbers come from.
    shape : Shape
        Outer shape.
    layers : tuple of Layer
        From the base upwards, covering the object without gap.
    joined_at_mm : tuple of float
        Heights above the base at which separately cast blocks merely lie on each other.
    nominal_spacing_mm, nominal_margin_mm : float or None
        Spacing of the marker lattice, and distance of its outermost markers from the faces of a box.
    nominal_heights_mm : tuple of float
        Heights of the marker layers above the base; empty when unknown.
    base_z_mm : float or None
        Estimated z of the base plane in the scan of the reference configuration.
    xy_scale : float
        Factor by which printed x, y must be multiplied according to the file (1 when nothing is known).
    xy_step_mm, z_step_mm : float
        Quantisation of the coordinates (pixel and slice pitch).
    sd_mm : tuple of float, shape (3,), or None
        Standard deviation of a measured coordinate along x, y, z, mm, where it was estimated with the positions.
    up_axis : str
        Axis that points away from the base.
    dimensions : int
        2 where the markers were seen in one vertical x-y plane only (their z is NaN), else 3.
    input_hashes : mapping
        SHA-256 of every file read, by its name inside the folder.
    """

    name: str
    title: str
    source: str
    shape: Shape
    layers: tuple[Layer, ...]
    loading: Loading
    states: tuple[State, ...]
    joined_at_mm: tuple[float, ...] = ()
    nominal_spacing_mm: float | None = None
    nominal_margin_mm: float | None = None
    nominal_heights_mm: tuple[float, ...] = ()
    base_z_mm: float | None = None
    xy_scale: float = 1.0
    xy_step_mm: float = 0.0
    z_step_mm: float = 0.0
    sd_mm: tuple[float, float, float] | None = None
    up_axis: Axis = "z"
    dimensions: Literal[2, 3] = 3
    known_problems: tuple[str, ...] = ()
    scanner: Mapping[str, object] = field(default_factory=dict)
    input_hashes: Mapping[str, str] = field(default_factory=dict)

    @property
    def initial(self) -> Markers:
        """Markers of the reference configuration."""
        markers = self.states[0].markers
        if markers is None:
            raise InputError(f"experiment {self.name!r} has no positions for its reference configuration {self.states[0].name!r}")
        return markers

    @property
    def height_mm(self) -> float:
        """Height of the object above its base in the reference configuration, mm."""
        return self.shape.size_mm["xyz".index(self.up_axis)]

    @property
    def full_platen_position_mm(self) -> float:
        """Height of the plate or bar, or distance of the side plates, at which they touch the undeformed object, mm."""
        size = self.shape.size_mm
        return size["xyz".index(self.loading.bar_axis)] if self.loading.kind == "side_plates" else size[2]

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials, from the base upwards, each once."""
        return tuple(dict.fromkeys(layer.material for layer in self.layers))

    @property
    def loaded_states(self) -> tuple[State, ...]:
        """Loaded states whose marker positions are present."""
        return tuple(s for s in self.states[1:] if s.loaded and s.markers is not None)

    def state(self, name: str) -> State:
        """Return the state called `name`.

        Raises
        ------
        InputError
            There is no such state; the message lists those there are.
        """
        for s in self.states:
            if s.name == name:
                return s
        raise InputError(f"experiment {self.name!r} has no state {name!r}; it has {', '.join(s.name for s in self.states)}")
