"""The server of the live page, over real sockets of the loopback interface: who is let in, what is sent, who drives."""

from __future__ import annotations

import gc
import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from naibu.core.errors import InputError
from naibu.viewer.live.commands import LiveCommand
from naibu.viewer.live.scene import DRIVING, HEADER, LiveFrame, LiveReading, LiveScene, frame_bytes
from naibu.viewer.live.server import COMMANDS_PER_S, LONGEST_MESSAGE, STILL_S, LiveServer, web_server
from naibu.viewer.motion_page import RigidShape

POINTS = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])


class Source:
    """A simulation that counts its frames and keeps what it was told."""

    def __init__(self) -> None:
        self.told: list[LiveCommand] = []
        self.shown = 0
        self.still = False
        self.said = ""
        tool = RigidShape("sphere", "sphere", np.array([3.0, 0.0, 0.0]), np.eye(3))
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        self.scene = LiveScene(
            "A <b>tetrahedron</b>", ["one cell"], POINTS, faces, np.array([[0, 1, 2, 3]]), [tool], [], np.zeros((0, 3)), "strain, %", 1 / 60
        )

    @property
    def number(self) -> int:
        return self.shown if self.still else self.shown + 1

    def frame(self) -> LiveFrame:
        self.shown = self.number
        centre, force = np.arange(3.0), np.array([0, 0, -5.0])
        return LiveFrame(self.shown, 0.5, POINTS + 1.0, 0, -1, centre, force, np.zeros(3), 0.25, 3.5, 60.0, 1.0, 0, lambda: np.arange(4.0))

    def command(self, command: LiveCommand) -> None:
        self.told.append(command)

    def trouble(self) -> str:
        said, self.said = self.said, ""
        return said

    def recording_html(self) -> str:
        raise InputError("nothing is recorded; press Record")


class Running:
    """A server in a thread."""

    def __init__(self) -> None:
        self.source = Source()
        self.live = LiveServer(self.source, "secret")
        bound = uvicorn.Config(self.live.app(0), host="127.0.0.1", port=0, log_level="critical").bind_socket()
        self.port = bound.getsockname()[1]
        self.server = web_server(self.live.app(self.port), "critical")
        self.thread = threading.Thread(target=self.server.run, kwargs={"sockets": [bound]}, daemon=True)
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)

    def get(self, path: str, **headers: str) -> tuple[int, str]:
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", headers={k.title(): v for k, v in headers.items()})
        try:
            with urllib.request.urlopen(request, timeout=20) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def session(self, token: str = "secret", **options: object) -> ClientConnection:
        return connect(f"ws://127.0.0.1:{self.port}/session?token={token}", **options)  # type: ignore[arg-type]


@pytest.fixture
def running() -> Iterator[Running]:
    made = Running()
    yield made
    made.server.should_exit = True
    made.thread.join(timeout=10)


def test_only_the_address_with_its_token_opens_the_page(running: Running) -> None:
    status, page = running.get("/?token=secret")
    assert status == 200
    assert "A &lt;b&gt;tetrahedron&lt;/b&gt;" in page
    assert "connect-src 'self'" in page
    assert running.get("/")[0] == 403
    assert running.get("/?token=other")[0] == 403
    assert running.get("/scene?token=secret", host="example.org")[0] == 403
    assert running.get("/scene?token=secret", origin="http://example.org")[0] == 403
    assert running.get("/scene?token=secret", origin=f"http://127.0.0.1:{running.port}")[0] == 200
    assert running.get("/recording?token=secret") == (409, "nothing is recorded; press Record")


@pytest.mark.parametrize("options", [{"token": "other"}, {"origin": "http://example.org"}])
def test_a_connection_from_elsewhere_is_refused(running: Running, options: dict[str, str]) -> None:
    with pytest.raises(InvalidStatus):
        running.session(**options)


def test_a_frame_holds_what_the_simulation_says(running: Running) -> None:
    with running.session() as link:
        link.send('{"type": "colour", "name": "strain"}')
        link.send('{"type": "next"}')
        data = link.recv(timeout=20)
    assert isinstance(data, bytes)
    header = np.frombuffer(data[: HEADER.itemsize], HEADER)[0]
    assert header["magic"] == b"NLV5"
    assert header["nodes"] == 4
    assert header["flags"] & DRIVING
    assert header["force"].tolist() == [0.0, 0.0, -5.0]
    assert (header["penetration"], header["indentation"], header["steps_per_s"]) == (0.25, 3.5, 60.0)
    values = np.frombuffer(data[HEADER.itemsize :], "<f4")
    np.testing.assert_array_equal(values[:12].reshape(4, 3), POINTS + 1.0)
    np.testing.assert_array_equal(values[12:], np.arange(4.0))


def test_readings_follow_the_values_at_the_nodes() -> None:
    readings = np.array([[1.5, 1.0, 2.0], [7.0, np.nan, np.nan]])
    frame = replace(Source().frame(), readings=readings)
    for values in (None, np.arange(4.0)):
        data = frame_bytes(frame, False, values)
        header = np.frombuffer(data[: HEADER.itemsize], HEADER)[0]
        assert header["readings"] == 2
        np.testing.assert_array_equal(np.frombuffer(data[-24:], "<f4").reshape(2, 3), readings)
        assert len(data) == HEADER.itemsize + 4 * (12 + (0 if values is None else 4) + 6)
    scene = replace(Source().scene, readings=(LiveReading("F_z", "mN", "force"),))
    sent = json.loads(json.dumps(scene.payload()))["readings"]
    assert sent == [{"name": "F_z", "unit": "mN", "plot": "force", "explanation": "", "states": []}]


def test_the_first_page_drives_the_others_watch_until_it_leaves(running: Running) -> None:
    def flags(link: ClientConnection) -> int:
        link.send('{"type": "next"}')
        return int(np.frombuffer(link.recv(timeout=20)[: HEADER.itemsize], HEADER)[0]["flags"])  # type: ignore[arg-type]

    with running.session() as first, running.session() as second:
        assert flags(first) & DRIVING
        assert not flags(second) & DRIVING
        second.send('{"type": "move", "at": [1, 2, 3]}')
        first.send('{"type": "move", "at": [4, 5, 6]}')
        flags(first)
        flags(second)
        assert [c.vector for c in running.source.told] == [(4.0, 5.0, 6.0)]
        first.close()
        for _ in range(100):
            if flags(second) & DRIVING:
                break
            time.sleep(0.02)
        assert flags(second) & DRIVING


def test_a_page_that_waits_for_a_frame_is_obeyed_meanwhile(running: Running) -> None:
    with running.session() as link:
        link.send('{"type": "next"}')
        link.recv(timeout=20)
        running.source.still = True  # as while the simulation takes long for a step: the next answer comes after STILL_S
        began = time.monotonic()
        link.send('{"type": "next"}')
        link.send('{"type": "move", "at": [1, 2, 3]}')
        while not running.source.told:
            time.sleep(0.001)
        with pytest.raises(TimeoutError):
            link.recv(timeout=max(0.0, began + 0.5 * STILL_S - time.monotonic()))
        assert link.recv(timeout=20)


def test_frames_are_sent_as_they_are(running: Running) -> None:
    with running.session() as link:  # the client offers compression
        assert link.protocol.extensions == []


@pytest.mark.parametrize("message", ["no json", '{"type": "move", "at": [1]}', b"\x00\x01", "x" * (LONGEST_MESSAGE + 1)])
def test_malformed_messages_close_their_own_connection_only(running: Running, message: str | bytes) -> None:
    with running.session() as good:
        with running.session() as bad, pytest.raises(ConnectionClosed):
            bad.send(message)
            bad.recv(timeout=20)
        good.send('{"type": "next"}')
        assert good.recv(timeout=20)


def test_too_many_commands_close_the_connection(running: Running) -> None:
    with running.session() as link, pytest.raises(ConnectionClosed):
        for _ in range(int(4 * COMMANDS_PER_S)):
            link.send('{"type": "release"}')
        link.recv(timeout=20)
    assert len(running.source.told) < 3 * COMMANDS_PER_S


def test_trouble_is_told_to_the_page_that_drives(running: Running) -> None:
    running.source.said = "there is no tool 'hammer'"
    with running.session() as link:
        link.send('{"type": "next"}')
        assert json.loads(link.recv(timeout=20)) == {"trouble": "there is no tool 'hammer'"}


@pytest.mark.parametrize("visits", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_pages_that_come_and_go_leave_nothing_behind(running: Running, visits: int) -> None:
    def visit() -> None:
        with running.session() as link:
            link.send('{"type": "next"}')
            link.recv(timeout=20)

    visit()
    for _ in range(20):
        visit()
    gc.collect()
    objects = len(gc.get_objects())
    tasks = threading.active_count()
    for _ in range(visits):
        visit()
    gc.collect()
    left = len(gc.get_objects()) - objects
    for _ in range(200):
        if not running.live.pages:
            break
        time.sleep(0.02)
    assert running.live.pages == []
    assert threading.active_count() <= tasks + 1
    assert left < 5 * visits  # a page that was kept holds dozens of objects
