"""A recording across cuts that cross is shown again frame by frame, whatever hands do meanwhile, and leaves the simulation as it was."""

from __future__ import annotations

import json

import numpy as np
import pytest
from touched_models import MODELS
from watched_page import WatchedPage

from naibu.simulation.frame import Frame
from naibu.viewer.live.commands import read_command


def blades(page: WatchedPage) -> list[list[list[list[float]]]]:
    """Two cuts from the top to the middle of the height, one across the other."""
    low, high = page.simulation.body.points.min(axis=0), page.simulation.body.points.max(axis=0)
    (x, y, z), (a, b, c), (d, e, _) = 0.5 * (low + high) + [0.7, -1.1, 0.0], low - 3.0, high + 3.0
    top = high[2] + 3.0
    assert c < z < top
    return [[[[x, end, top], [x, end, z]] for end in (b, e)], [[[end, y, top], [end, y, z]] for end in (a, d)]]


def recorded(page: WatchedPage) -> None:
    """Record a motion across both cuts."""
    page.say('{"type": "record", "on": true}')
    for edges in blades(page):
        page.say(json.dumps({"type": "cut", "edges": edges}))
        for _ in range(6):
            page.frame()
    page.say('{"type": "record", "on": false}')


def shown(page: WatchedPage, *messages: str) -> list[Frame]:
    """Return the frames that are shown while the recording is shown again, with these messages behind each but the last."""
    page.say('{"type": "replay"}')
    frames, loop = [], page.page.loop
    while loop.replaying:
        page._due = loop._once(page._due)
        page._clock = max(page._clock, page._due)
        for message in messages if loop.replaying else ():
            page.page.command(read_command(message))
        loop._obey()
        frames.append(loop.latest()[0])
        assert page.page.scene.topology == frames[-1].topology
        assert len(page.page.frame().positions) == len(page.page.scene.points)
    return frames


@pytest.mark.parametrize("kind", ["gel", "lattice"])
def test_a_recording_across_crossing_cuts_is_shown_as_it_was(kind: str) -> None:
    page = WatchedPage(MODELS[kind]())
    try:
        page.frame()
        recorded(page)
        simulation, loop = page.simulation, page.page.loop
        kept, before = loop.recorded(), simulation._session.state()
        assert {frame.topology for frame in kept} >= {1, 2}
        frames = shown(page, '{"type": "move", "at": [0, 0, 90]}')
        assert len(frames) == len(kept) and all(a is b for a, b in zip(frames, kept, strict=True))
        after = simulation._session.state()
        state, same = (before.displacement, after.displacement) if kind == "gel" else (before.position, after.position)
        np.testing.assert_array_equal(same, state)
        np.testing.assert_array_equal(after.velocity, before.velocity)
        page.frame()
        assert loop.latest()[0] is simulation.last and simulation.last.topology == 2
    finally:
        page.close()


def test_a_paused_page_shows_the_simulation_again_behind_a_recording() -> None:
    """It went on to show the end of the recording: of a cut, for example, that had been undone."""
    page = WatchedPage(MODELS["lattice"]())
    try:
        recorded(page)
        page.say('{"type": "undo"}')
        page.say('{"type": "undo"}')
        page.say('{"type": "pause", "on": true}')
        assert {frame.topology for frame in shown(page)} >= {2}
        page.frame()
        frame = page.page.loop.latest()[0]
        assert frame is page.simulation.last and frame.body is page.simulation.body and frame.body is page.model.body
    finally:
        page.close()


@pytest.mark.parametrize("message", ['{"type": "grip", "node": 3}', '{"type": "cut", "edges": [[[0,0,0],[0,0,9]],[[9,0,0],[9,0,9]]]}'])
def test_nothing_is_gripped_or_cut_on_a_recording(message: str) -> None:
    """Its nodes and its place need not be those of the body that is simulated."""
    page = WatchedPage(MODELS["lattice"]())
    try:
        recorded(page)
        kept = len(page.simulation._kept)
        shown(page, message)
        assert page.simulation.last.gripped == -1 and len(page.simulation._kept) == kept
        assert "the recording is being shown" in page.page.trouble()
    finally:
        page.close()
