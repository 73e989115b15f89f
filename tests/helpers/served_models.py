"""A model on a live page, served by a thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from touched_lattice import touched_lattice

from naibu.simulation import InteractiveSimulation, RealTimeLoop
from naibu.viewer.live.server import LiveServer, web_server
from naibu.workflows import TouchableModel, tools_for
from naibu.workflows.interactive.live import LiveSimulation


@contextmanager
def served(model: TouchableModel | None = None, port: int = 0) -> Iterator[tuple[str, LiveSimulation]]:
    """Serve a model, by default a small lattice; yields the address and the simulation."""
    model = model or TouchableModel("Cube", ("a small lattice",), touched_lattice(), "mean elongation, %")
    with RealTimeLoop(InteractiveSimulation(model.body, model.tools or tools_for(model.body))) as loop:
        simulation = LiveSimulation(model, loop)
        pages = LiveServer(simulation, "secret")
        bound = uvicorn.Config(pages.app(0), host="127.0.0.1", port=port, log_level="critical").bind_socket()
        chosen = bound.getsockname()[1]
        server = web_server(pages.app(chosen), "critical")
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{chosen}/?token=secret", simulation
        server.should_exit = True
        thread.join(timeout=10)
