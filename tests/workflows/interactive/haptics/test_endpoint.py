"""Packets and endpoint of haptic devices: the documented layout, and what is dropped."""

from __future__ import annotations

import socket
import struct
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.simulation import DeviceForce, DevicePose
from naibu.workflows.interactive.haptics.endpoint import DeviceDatagrams, HapticEndpoint
from naibu.workflows.interactive.haptics.packets import force_bytes, pose_bytes, read_force, read_pose

HERE = ("127.0.0.1", 5000)
POSE = DevicePose(7, 1.5, np.array([1.0, -2.0, 3.5]), np.array([0.0, 1.0, 0.0, 0.0]), 3, 6, -40.0)


def test_a_pose_has_the_documented_layout() -> None:
    packet = pose_bytes(POSE)
    assert len(packet) == 88
    assert packet[:4] == b"NHP1"
    assert packet[4:16] == bytes([2, 0, 3, 0, 7, 0, 0, 0, 6, 0, 0, 0])
    assert struct.unpack_from("<9d", packet, 16) == (1.5, 1.0, -2.0, 3.5, 0.0, 1.0, 0.0, 0.0, -40.0)
    again = read_pose(packet)
    assert (again.sequence, again.time_s, again.buttons, again.applied, again.energy_mn_mm) == (7, 1.5, 3, 6, -40.0)
    np.testing.assert_array_equal(again.position, POSE.position)
    np.testing.assert_array_equal(again.quaternion, POSE.quaternion)


def test_an_answer_has_the_documented_layout() -> None:
    packet = force_bytes(DeviceForce(9, 7, 1.5, np.array([10.0, 0.0, -250.0]), 5, 960.0))
    assert len(packet) == 80
    assert packet[:4] == b"NHF1"
    assert packet[4:16] == bytes([2, 0, 5, 0, 9, 0, 0, 0, 7, 0, 0, 0])
    assert struct.unpack_from("<8d", packet, 16) == (1.5, 10.0, 0.0, -250.0, 0.0, 0.0, 0.0, 960.0)
    again = read_force(packet)
    assert (again.number, again.sequence, again.flags, again.energy_mn_mm) == (9, 7, 5, 960.0)


@pytest.mark.parametrize(
    "packet",
    [
        b"", b"x", pose_bytes(POSE)[:-1], pose_bytes(POSE) + b"\0", b"NHP2" + pose_bytes(POSE)[4:],
        pose_bytes(POSE)[:4] + b"\1\0" + pose_bytes(POSE)[6:], pose_bytes(replace(POSE, position=np.array([np.nan, 0, 0]))),
        pose_bytes(replace(POSE, position=np.array([np.inf, 0, 0]))), pose_bytes(replace(POSE, position=np.array([0, 1e7, 0]))),
        pose_bytes(replace(POSE, time_s=float("nan"))), pose_bytes(replace(POSE, energy_mn_mm=float("nan"))),
        pose_bytes(replace(POSE, quaternion=np.zeros(4))),
        pose_bytes(replace(POSE, quaternion=np.array([np.nan, 0, 0, 1]))), force_bytes(DeviceForce(1, 1, 0.0, np.zeros(3), 0)),
    ],
    ids=["empty", "x", "short", "long", "magic", "version", "nan", "inf", "far", "time", "energy", "no rotation", "nan rotation", "answer"],
)  # fmt: skip
def test_malformed_packets_are_dropped_and_counted(packet: bytes) -> None:
    datagrams = DeviceDatagrams()
    assert datagrams.accepted(packet, HERE) is None
    assert datagrams.dropped == {"malformed": 1}
    assert datagrams.device is None


def test_old_and_repeated_packets_are_dropped_also_where_numbers_wrap() -> None:
    datagrams = DeviceDatagrams()
    numbers = [2**32 - 2, 2**32 - 1, 2**32 - 1, 1, 0, 2, 2**32 - 3, 3]
    passed = [n for n in numbers if datagrams.accepted(pose_bytes(replace(POSE, sequence=n)), HERE) is not None]
    assert passed == [2**32 - 2, 2**32 - 1, 1, 2, 3]
    assert datagrams.dropped == {"old": 3}


def test_one_device_leads_and_others_are_foreign() -> None:
    with HapticEndpoint(0) as endpoint, ExitStack() as stack:
        first, second, elsewhere = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3))
        elsewhere.bind(("127.0.0.2", 0))
        for each in (first, second, elsewhere):
            each.settimeout(5.0)
        to = ("127.0.0.1", endpoint.port)
        elsewhere.sendto(pose_bytes(POSE), to)
        assert endpoint.receive() == []
        first.sendto(pose_bytes(POSE), to)
        first.sendto(pose_bytes(replace(POSE, sequence=8)), to)
        second.sendto(pose_bytes(replace(POSE, sequence=9)), to)
        assert [pose.sequence for pose in endpoint.receive()] == [7, 8]
        assert endpoint.datagrams.dropped == {"foreign": 2}
        endpoint.send(DeviceForce(1, 8, 1.5, np.array([1.0, 2.0, 3.0]), 1))
        np.testing.assert_array_equal(read_force(first.recv(100)).force_mn, [1.0, 2.0, 3.0])
        endpoint.leave()
        second.sendto(pose_bytes(replace(POSE, sequence=1)), to)
        assert [pose.sequence for pose in endpoint.receive()] == [1]
        with pytest.raises(InputError, match=f"port {endpoint.port} is taken"):
            HapticEndpoint(endpoint.port)
    with pytest.raises(InputError, match="between 0 and 65535"):
        HapticEndpoint(-1)
