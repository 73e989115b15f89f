"""Server of the live page: one page, one scene, one binary websocket, for readers on this machine only.

It answers only requests that name this machine as their host, come from its own page or from no page, and carry the token of the address;
so that another site that is open in the browser can neither read the simulation nor steer it. One page drives, others watch.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from socket import socket as Socket
from time import monotonic
from typing import Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from naibu.core.errors import InputError, NaibuError
from naibu.viewer.live.commands import LiveCommand, read_command
from naibu.viewer.live.page import live_html
from naibu.viewer.live.scene import LiveFrame, LiveScene, frame_bytes

LONGEST_MESSAGE = 65_536  # bytes
COMMANDS_PER_S = 600.0  # of one page; more close its connection
MOST_PAGES = 16
POLL_S = 0.002
STILL_S = 0.25  # a page that waits for a frame of a paused simulation gets the old one again
NOT_ALLOWED, TOO_MUCH, MALFORMED, FULL = 1008, 1008, 1007, 1013


class LiveSource(Protocol):
    """What the server shows and steers."""

    @property
    def scene(self) -> LiveScene:
        """What does not change."""

    @property
    def number(self) -> int:
        """Number of the last frame."""

    def frame(self) -> LiveFrame:
        """Return the last frame."""

    def command(self, command: LiveCommand) -> None:
        """Carry out a command of the page that drives."""

    def trouble(self) -> str:
        """Return what was wrong with the last command that failed, once."""

    def recording_html(self) -> str:
        """Return the recorded motion as a page; InputError where nothing is recorded."""


@dataclass(slots=True, eq=False)
class _Page:
    """A connected page."""

    coloured_by_strain: bool = False
    sent: int = -1
    wants: asyncio.Event = field(default_factory=asyncio.Event)  # another frame
    allowance: float = COMMANDS_PER_S
    _spoke: float = field(default_factory=monotonic)

    def may_speak(self) -> bool:
        """Count a command against the rate limit (token bucket)."""
        now = monotonic()
        self.allowance = min(COMMANDS_PER_S, self.allowance + (now - self._spoke) * COMMANDS_PER_S) - 1.0
        self._spoke = now
        return self.allowance >= 0.0


@dataclass(slots=True, eq=False)
class LiveServer:
    """The live page of one simulation.

    Attributes
    ----------
    source : LiveSource
        The simulation.
    token : str
        Secret part of the address.
    pages : list
        Connected pages; the first one drives.
    """

    source: LiveSource
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    pages: list[_Page] = field(default_factory=list)

    def app(self, port: int) -> Starlette:
        """Return the application for a port of this machine."""
        hosts = frozenset(f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]"))

        def allowed(connection: HTTPConnection) -> bool:
            origin = connection.headers.get("origin")
            return (
                connection.headers.get("host") in hosts
                and (origin is None or origin.removeprefix("http://") in hosts)
                and secrets.compare_digest(connection.query_params.get("token", "").encode(), self.token.encode())
            )

        def guarded(answer: Callable[[], Response]) -> Callable[[Request], Response]:
            def endpoint(request: Request) -> Response:
                if not allowed(request):
                    return PlainTextResponse("Open the address that naibu live printed, with its token.", 403)
                response = answer()
                response.headers["Cache-Control"] = "no-store"
                response.headers["X-Content-Type-Options"] = "nosniff"
                response.headers["Referrer-Policy"] = "no-referrer"
                return response

            return endpoint

        async def session(socket: WebSocket) -> None:
            if not allowed(socket):
                await socket.close(NOT_ALLOWED)
                return
            await self._serve(socket)

        routes = [
            Route("/", guarded(lambda: HTMLResponse(live_html(self.source.scene)))),
            Route("/scene", guarded(lambda: JSONResponse(self.source.scene.payload()))),
            Route("/recording", guarded(self._recording)),
            WebSocketRoute("/session", session),
        ]
        return Starlette(routes=routes)

    def _recording(self) -> Response:
        try:
            page = self.source.recording_html()
        except NaibuError as error:
            return PlainTextResponse(str(error), 409)
        return HTMLResponse(page, headers={"Content-Disposition": 'attachment; filename="naibu-recording.html"'})

    async def _serve(self, socket: WebSocket) -> None:
        """Answer one page until it leaves."""
        if len(self.pages) >= MOST_PAGES:
            await socket.close(FULL)
            return
        await socket.accept()
        page = _Page()
        self.pages.append(page)
        both = [asyncio.ensure_future(self._hear(socket, page)), asyncio.ensure_future(self._show(socket, page))]
        try:
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.pages.remove(page)
            for task in both:
                task.cancel()
        ended = await asyncio.gather(*both, return_exceptions=True)
        for error in ended:
            # a page that left, or a binary message, which has no text; what was cancelled ended with the other one
            if isinstance(error, BaseException) and not isinstance(error, WebSocketDisconnect | KeyError | asyncio.CancelledError):
                raise error

    async def _hear(self, socket: WebSocket, page: _Page) -> None:
        """Carry out what a page says, at once: also while it waits for a frame."""
        while True:
            text = await socket.receive_text()
            if not page.may_speak():
                await socket.close(TOO_MUCH, "too many commands a second")
                return
            try:
                command = read_command(text)
            except InputError as error:
                await socket.close(MALFORMED, str(error)[:120])
                return
            if command.kind == "next":
                page.wants.set()
            elif command.kind == "colour":
                page.coloured_by_strain = command.name == "strain"
                page.sent = -1
            elif self.pages[0] is page:
                self.source.command(command)

    async def _show(self, socket: WebSocket, page: _Page) -> None:
        """Send a frame that the page has not seen whenever it wants one."""
        while True:
            await page.wants.wait()
            page.wants.clear()
            began = monotonic()
            while self.source.number == page.sent and monotonic() - began < STILL_S:
                await asyncio.sleep(POLL_S)
            frame = self.source.frame()
            page.sent = frame.number
            values = frame.strain() if page.coloured_by_strain else None
            driving = self.pages[0] is page
            trouble = self.source.trouble() if driving else ""
            if socket.application_state is not WebSocketState.CONNECTED:
                return  # closed for what the page said
            if trouble:
                await socket.send_json({"trouble": trouble})
            await socket.send_bytes(frame_bytes(frame, driving, values))


@contextmanager
def bound_port(port: int) -> Iterator[Socket]:
    """Keep a port of the loopback interface for `serve`; 0 takes a free one.

    Raises
    ------
    InputError
        The port is taken.
    """
    config = uvicorn.Config(_nothing, host="127.0.0.1", port=port, log_level="critical")
    try:
        bound = config.bind_socket()
    except SystemExit as error:
        raise InputError(f"port {port} is taken or not allowed; choose another, or 0 for a free one") from error
    try:
        yield bound
    finally:
        bound.close()


def serve(server: LiveServer, bound: Socket, ready: Callable[[str], None]) -> None:
    """Serve the page on the loopback interface until Ctrl-C.

    Parameters
    ----------
    server : LiveServer
        What is served.
    bound : socket
        Of `bound_port`.
    ready : callable
        Called with the address, token included, once the page can be opened.
    """
    try:
        bound.listen()  # what connects from now on waits for the server
    except OSError as error:  # two may bind a port that nobody listens at yet
        raise InputError(f"port {bound.getsockname()[1]} is taken; choose another, or 0 for a free one") from error
    chosen = bound.getsockname()[1]
    ready(f"http://127.0.0.1:{chosen}/?token={server.token}")
    web_server(server.app(chosen)).run(sockets=[bound])


def web_server(app: Starlette, log_level: str = "warning") -> uvicorn.Server:
    """Return the server of an application; it sends frames as they are: on one machine, compressing them takes longer than sending them."""
    return uvicorn.Server(
        uvicorn.Config(
            app, log_level=log_level, lifespan="off", ws="websockets-sansio", ws_max_size=LONGEST_MESSAGE, ws_per_message_deflate=False,
            timeout_graceful_shutdown=1, server_header=False, date_header=False,
        )
    )  # fmt: skip


async def _nothing(*_: object) -> None:
    """Stand for the application while the port is bound."""
