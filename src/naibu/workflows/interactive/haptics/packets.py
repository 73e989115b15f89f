"""Packets between a haptic device and the live simulation: two structures of fixed layout, little-endian, without padding."""

from __future__ import annotations

import math
import struct

import numpy as np

from naibu.core.errors import InputError
from naibu.simulation.haptics.haptic_loop import DeviceForce, DevicePose

VERSION = 2
POSE_MAGIC, FORCE_MAGIC = b"NHP1", b"NHF1"
POSE = struct.Struct("<4sHHIId3d4dd")  # magic, version, buttons, sequence, applied, time, position, quaternion, energy
FORCE = struct.Struct("<4sHHIId3d3dd")  # magic, version, flags, number, sequence, time, force, torque, energy
LARGEST = 1e6  # mm; of a coordinate
UNIT = 1e-3  # by which the length of a quaternion may differ from one


def pose_bytes(pose: DevicePose) -> bytes:
    """Return a pose as a packet of 88 bytes."""
    place = (*pose.position.tolist(), *pose.quaternion.tolist())
    return POSE.pack(POSE_MAGIC, VERSION, pose.buttons, pose.sequence, pose.applied, pose.time_s, *place, pose.energy_mn_mm)


def read_pose(packet: bytes) -> DevicePose:
    """Read a packet of a device.

    Raises
    ------
    InputError
        Another length, magic or version, a number that is not finite, a coordinate above 1e6 mm, or a quaternion that is none.
    """
    if len(packet) != POSE.size:
        raise InputError(f"a pose has {POSE.size} bytes, not {len(packet)}")
    magic, version, buttons, sequence, applied, time_s, *values = POSE.unpack(packet)
    if magic != POSE_MAGIC or version != VERSION:
        raise InputError(f"a pose begins with {POSE_MAGIC!r} and version {VERSION}, not {magic!r} and {version}")
    position, quaternion, energy = np.array(values[:3]), np.array(values[3:7]), values[7]
    finite = math.isfinite(time_s) and math.isfinite(energy)
    if not finite or not np.abs(position).max() <= LARGEST or not abs(np.linalg.norm(quaternion) - 1.0) <= UNIT:
        raise InputError(f"a pose must have a finite time and energy, coordinates of at most {LARGEST:g} mm, and a unit quaternion")
    return DevicePose(sequence, time_s, position, quaternion, buttons, applied, energy)


def force_bytes(answer: DeviceForce) -> bytes:
    """Return an answer as a packet of 80 bytes; its torque is zero."""
    values = (*answer.force_mn.tolist(), 0.0, 0.0, 0.0, answer.energy_mn_mm)
    return FORCE.pack(FORCE_MAGIC, VERSION, answer.flags, answer.number, answer.sequence, answer.time_s, *values)


def read_force(packet: bytes) -> DeviceForce:
    """Read an answer.

    Raises
    ------
    InputError
        Another length, magic or version, or a force that is not finite.
    """
    if len(packet) != FORCE.size:
        raise InputError(f"an answer has {FORCE.size} bytes, not {len(packet)}")
    magic, version, flags, number, sequence, time_s, *values = FORCE.unpack(packet)
    if magic != FORCE_MAGIC or version != VERSION or not all(math.isfinite(value) for value in values):
        raise InputError(f"an answer begins with {FORCE_MAGIC!r} and version {VERSION}, and its numbers are finite")
    return DeviceForce(number, sequence, time_s, np.array(values[:3]), flags, values[6])
