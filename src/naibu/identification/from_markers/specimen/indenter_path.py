"""Parameters of the boundary conditions of a loaded state, and how they move its indenters.

A plate or bar above an object moves down, and may tilt about both horizontal axes; a bar may lie off the middle and be turned. Two side
plates move towards each other and may lean, both by one angle: they are guided by one rig, and on a quarter of the object, which mirror
planes complete, no other angle can be modelled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from naibu.core.experiment import Experiment, State
from naibu.core.parameters import Parameter
from naibu.core.rigid_transform import rotation_matrix
from naibu.identification.from_markers.specimen.parameter_names import bar_offset, bar_yaw, plate_tilt, platen_position, side_plate_tilt
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_strain.sensitivities import Direction

PLATEN_POSITION_SD_MM = 5.0
TILT_SD_RAD = 0.01
OFFSET_SD_MM, YAW_SD_RAD = 1.0, 0.02  # of a bar


def state_parameters(experiment: Experiment, state: State) -> list[Parameter]:
    """Return the parameters of the boundary conditions of one state, with their priors."""
    full = experiment.full_platen_position_mm
    start = state.estimated_mm or state.stated_mm or 0.7 * full
    out = [Parameter(platen_position(experiment, state.name), float(start), "mm", prior_sd=PLATEN_POSITION_SD_MM)]
    if experiment.loading.kind == "side_plates":
        tilts = [side_plate_tilt(experiment, state.name)]
    else:
        tilts = [plate_tilt(experiment, state.name, axis) for axis in "xy"]
    out += [Parameter(name, 0.0, "rad", prior_sd=TILT_SD_RAD) for name in tilts]
    if experiment.loading.kind == "bar":
        out.append(Parameter(bar_offset(experiment, state.name), 0.0, "mm", prior_sd=OFFSET_SD_MM))
        out.append(Parameter(bar_yaw(experiment, state.name), 0.0, "rad", prior_sd=YAW_SD_RAD))
    return out


def path_directions(contact: Contact, experiment: Experiment, state: str) -> dict[str, Direction]:
    """Return how every parameter of a state moves an indenter, per unit of the parameter."""
    x, y, z = np.eye(3)
    position = platen_position(experiment, state)
    if experiment.loading.kind == "side_plates":
        inward = contact.surface.normal
        lean = np.cross(z, inward)  # the rotation that takes what is above the plate's reference point towards the object
        return {position: Direction(stop=-0.5 * inward), side_plate_tilt(experiment, state): Direction(tilt=lean)}
    tilts = {plate_tilt(experiment, state, name): Direction(tilt=axis) for name, axis in (("x", x), ("y", y))}
    out = {position: Direction(stop=z), **tilts}
    if experiment.loading.kind == "bar":
        lateral = x if experiment.loading.bar_axis == "y" else y
        out[bar_offset(experiment, state)] = Direction(start=lateral, stop=lateral)
        out[bar_yaw(experiment, state)] = Direction(rotation=z)
    return out


def moved_indenter(contact: Contact, experiment: Experiment, state: str, values: Mapping[str, float]) -> Contact:
    """Return an indenter with the ends of its path, its yaw and its tilt as the parameters of a state have them."""
    start, stop, yaw, tilt = contact.start.copy(), contact.stop.copy(), np.zeros(3), np.zeros(3)
    position = platen_position(experiment, state)
    for name, rate in path_directions(contact, experiment, state).items():
        reference = experiment.full_platen_position_mm if name == position else 0.0  # where the body is at its start
        change = values.get(name, reference) - reference
        for target, by in ((start, rate.start), (stop, rate.stop), (yaw, rate.rotation), (tilt, rate.tilt)):
            if by is not None:
                target += by * change
    return replace(contact, start=start, stop=stop, rotation=rotation_matrix(yaw) @ contact.rotation, tilt=tilt)
