"""Names of the parameters of a measured object, each made in one place."""

from __future__ import annotations

from naibu.core.experiment import Experiment

SHAPE_NAMES: dict[str, tuple[str, ...]] = {"mooney_rivlin": ("c01_fraction",), "yeoh": ("c20_ratio", "c30_ratio")}


def young_modulus(material: str) -> str:
    """Name of the Young's modulus of `material`."""
    return f"{material}: young_modulus"


def poisson_ratio(material: str) -> str:
    """Name of the Poisson's ratio of `material`."""
    return f"{material}: poisson_ratio"


def shape_parameter(material: str, name: str) -> str:
    """Name of a dimensionless parameter of the law of `material`, such as ``c01_fraction``."""
    return f"{material}: {name}"


def is_of_material(name: str) -> bool:
    """Whether a parameter is one of a material or a batch, which all objects of it share: a stiffness, a Poisson's ratio, a shape."""
    kinds = ("young_modulus", "poisson_ratio", "stiffness", *(kind for kinds in SHAPE_NAMES.values() for kind in kinds))
    return name.endswith(tuple(f": {kind}" for kind in kinds))


def law_of_shape(kind: str, own: str) -> str | None:
    """Return the name of the law that has the shape parameter `kind`: `own` where it does; None where no law has it."""
    laws = [law for law, kinds in SHAPE_NAMES.items() if kind in kinds]
    return own if own in laws else next(iter(laws), None)


def batch_stiffness(batch: str) -> str:
    """Name of the factor by which all moduli of a batch differ from those of their materials."""
    return f"batch {batch}: stiffness"


def friction(material: str, body: str) -> str:
    """Name of the friction coefficient (or, for springs, the tangential stiffness) of `material` on `body`."""
    return f"{material} on {body}: friction"


def joint_friction(experiment: Experiment, height: float) -> str:
    """Name of the friction coefficient between the blocks that meet at `height` above the base, mm."""
    below = next(layer.material for layer in experiment.layers if layer.to_base_mm >= height - 1e-9)
    above = next(layer.material for layer in experiment.layers if layer.to_base_mm > height + 1e-9)
    return friction(*sorted((below, above), reverse=True))


def base_offset(experiment: Experiment) -> str:
    """Name of the height by which all markers lie above their supposed position in the object, mm."""
    return f"{experiment.name}: base_offset"


def pixel_scale(experiment: Experiment) -> str:
    """Name of the true mm along x and y for a printed mm."""
    return f"{experiment.name}: pixel_scale"


def layer_shift(experiment: Experiment, height: float) -> str:
    """Name of the height by which the boundary between layers lies above its nominal `height`, mm."""
    return f"{experiment.name}: shift_of_layer_at_{height:g}"


def straight_base(experiment: Experiment) -> str:
    """Name of the height of straight-sided material below a half ellipsoid, mm."""
    return f"{experiment.name}: straight_base"


def platen_position(experiment: Experiment, state: str) -> str:
    """Name of the height of the plate or bar above the base, or of the distance between side plates, in a state."""
    kind = "width" if experiment.loading.kind == "side_plates" else "height"
    return f"{experiment.name}/{state}: {kind}"


def side_plate_tilt(experiment: Experiment, state: str) -> str:
    """Name of the angle by which both side plates lean towards the object in a state, rad: positive where they are closer above."""
    return f"{experiment.name}/{state}: tilt"


def plate_tilt(experiment: Experiment, state: str, axis: str) -> str:
    """Name of the rotation of a plate or bar about a horizontal axis, ``"x"`` or ``"y"``, in a state, rad."""
    return f"{experiment.name}/{state}: tilt_{axis}"


def bar_offset(experiment: Experiment, state: str) -> str:
    """Name of the distance of a bar from the middle of the object in a state, mm."""
    return f"{experiment.name}/{state}: bar_offset"


def bar_yaw(experiment: Experiment, state: str) -> str:
    """Name of the rotation of a bar about the vertical in a state, rad."""
    return f"{experiment.name}/{state}: bar_yaw"
