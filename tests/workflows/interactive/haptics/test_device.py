"""A simulated device drives a live lattice over the loopback interface."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from touched_lattice import TOP, touched_lattice

from naibu.core.errors import InputError
from naibu.mechanics import Assembler, elements, material
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, ForceLimits, InteractiveSimulation, SimulatedDevice
from naibu.simulation.haptics.haptic_loop import WAITS, DeviceForce, DevicePose
from naibu.workflows import TouchableModel, drive_live_simulation, live, tools_for, touched_loop
from naibu.workflows.interactive.haptics.packets import pose_bytes, read_force


def device() -> SimulatedDevice:
    """A hand that comes down 16 mm and stirs."""
    return SimulatedDevice(lambda t: np.array([3.0 * np.sin(6.0 * t), 0.0, -16.0 * min(t, 1.0)]))


def driven(seconds: float) -> None:
    model = TouchableModel("Cube", (), touched_lattice(), "mean elongation, %")
    interval = sys.getswitchinterval()
    with touched_loop(model, 0) as loop:
        assert loop.hand is not None
        port, limits = loop.hand.channel.port, loop.hand.limits
        record = drive_live_simulation(device(), port, seconds, loss=0.01, reordering=0.01, seed=3)
        frame = loop.latest()[0]
        counted = loop.hand.channel.datagrams.dropped
    assert sys.getswitchinterval() == interval
    assert record.steps_mn.max() <= limits.step_mn * (1 + 1e-9)
    assert np.linalg.norm(record.forces, axis=1).max() > 50.0
    assert record.most_work <= limits.energy_mn_mm * (1 + 1e-9)  # however late answers come
    assert frame.tool_centre[2] < TOP + 20.0
    assert counted["old"] > 0
    assert not counted["foreign"]
    assert not counted["malformed"]


def test_a_device_drives_a_lattice_over_udp() -> None:
    driven(2.0)


@pytest.mark.slow
def test_a_device_drives_a_lattice_for_a_while() -> None:
    driven(10.0)


def test_a_device_feels_finite_elements_between_their_steps() -> None:
    mesh = box((40.0, 40.0, 40.0), (4, 4, 4))
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=10.0, poisson_ratio=0.45)]
    )
    body = FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9).astype(np.int64))
    pushed = InteractiveSimulation(body, tools_for(body))  # kernels are compiled, and a tangent made, before the device comes
    pushed.take("sphere")
    pushed.move((0.0, 0.0, 40.0))
    while not pushed.last.force[2] < 0.0:
        assert not pushed.advance().failed
    pushed.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    limits = ForceLimits()
    with touched_loop(TouchableModel("Gel", (), body, "strain, %"), port) as loop:
        assert loop.hand is None  # beside the loop
        record = drive_live_simulation(SimulatedDevice(lambda t: np.array([0.0, 0.0, -24.0 * min(t, 1.0)])), port, 3.0, loss=0.01, seed=1)
        frame = loop.latest()[0]
    assert frame.force[2] < -50.0
    assert np.linalg.norm(record.forces, axis=1).max() > 50.0
    assert record.steps_mn.max() <= limits.step_mn * (1 + 1e-9)


def test_a_device_is_told_that_the_simulation_is_being_prepared() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        port = line.getsockname()[1]
    told: list[DeviceForce] = []

    class Enough(Exception):
        pass

    def preparing() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.connect(("127.0.0.1", port))
            line.settimeout(10.0)
            for sequence in (1, 2):
                line.send(pose_bytes(DevicePose(sequence, 1e-3 * sequence, np.array([0.0, 0.0, -9.0]))))
                told.append(read_force(line.recv(200)))
        raise Enough

    with pytest.raises(Enough):
        live("no-such-model", port=0, haptics_port=port, preparing=preparing, ready=lambda _: None)
    assert all(answer.flags & WAITS for answer in told)
    assert told[1].number > told[0].number
    assert not np.any([answer.force_mn for answer in told])


def test_what_cannot_be_served_is_refused() -> None:
    with pytest.raises(InputError, match="haptics_port must lie between 1 and 65535"):
        live("cube-pushing", port=0, haptics_port=0, ready=lambda _: None)
    with pytest.raises(InputError, match="no answer came"):
        drive_live_simulation(device(), 9, 0.05)


@pytest.mark.skipif(shutil.which("cc") is None or sys.platform != "linux", reason="needs a C compiler on Linux")
def test_the_client_of_the_documentation_is_led_by_the_same_rules(tmp_path: Path) -> None:
    source = Path(__file__).parents[4] / "docs" / "haptic_client.c"
    client = tmp_path / "client"
    subprocess.run(["cc", "-Wall", "-Wextra", "-Werror", source, "-o", client, "-lm"], check=True)
    with touched_loop(TouchableModel("Cube", (), touched_lattice(), "mean elongation, %"), 0) as loop:
        assert loop.hand is not None
        said = subprocess.run([client, str(loop.hand.channel.port), "2.5"], check=True, capture_output=True, text=True).stdout
        assert not loop.hand.channel.datagrams.dropped
    numbers = [float(word) for word in said.replace(",", " ").split() if word.lstrip("-").replace(".", "").isdigit()]
    poses, answers, x, y, z, flags = numbers
    assert poses == 2500
    assert answers > 50
    assert z > 100.0 > 10.0 * max(abs(x), abs(y))
    assert int(flags) & 1
