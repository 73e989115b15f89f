"""Whatever hands do on the live page, the simulation goes on: random pushes, pulls, cuts, undos and nonsense, seed by seed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from touched_models import MODELS
from watched_page import WatchedPage, driven

FRAMES = {"demo": 120}  # of a long session, less than others where a frame behind a cut takes seconds that runs be repeatable


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["lattice", "mesh", "gel"])
def test_random_hands_do_no_harm(kind: str, seed: int) -> None:
    """No exception, nothing infinite, nothing flung away, undo exact, volumes kept by cuts, and all comes to rest."""
    page = driven(MODELS[kind](), seed, 120 if kind == "lattice" else 40, settling_s=2.0)
    assert page.failures == []


@pytest.mark.parametrize("kind", ["lattice", "mesh"])
def test_the_same_hands_do_the_same(kind: str) -> None:
    """Bit by bit, cuts included."""
    first, second = (driven(MODELS[kind](), 7, 60).simulation.last for _ in range(2))
    assert first.number == second.number and first.tool == second.tool
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.force, second.force)


@pytest.mark.parametrize("seed", range(3))
def test_a_body_that_nobody_cut_comes_back_to_its_shape(seed: int) -> None:
    """An elastic one that is held; a lattice of dashpots in series keeps dents, as dough does."""
    page = driven(MODELS["mesh"](), 100 + seed, 60, cuts=False, settling_s=2.0)
    assert page.failures == [] and page.left < 1e-3


def test_a_cut_that_opens_in_the_frame_in_which_a_node_is_gripped_is_undone_for_itself() -> None:
    """Both keep a state; long runs of hands counted one of them, and failed where rounding let a tool leave a gel just then."""
    page = WatchedPage(MODELS["mesh"]())
    try:
        page.frame()
        points = page.simulation.body.points
        (_, y, z), top = points.max(axis=0) + 1.0, int(points[:, 2].argmax())
        edges = [[[0.0, end, z], [0.0, end, 0.5 * z]] for end in (-y, y)]
        page.say(json.dumps({"type": "cut", "edges": edges}))
        page.say(json.dumps({"type": "grip", "node": top}))
        assert page.simulation.last.topology == 1 and len(page.simulation._kept) == 2
        page.frame()
        for _ in range(2):
            page.say('{"type": "undo"}')
        assert not page.simulation._kept
        assert page.failures == []
    finally:
        page.close()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1006))
@pytest.mark.parametrize("kind", ["lattice", "cube", "dough", "dough-held", "octree", "mesh", "gel", "demo"])
def test_random_hands_do_no_harm_for_long(kind: str, seed: int) -> None:
    page = driven(MODELS[kind](), seed, FRAMES.get(kind, 300), settling_s=3.0)
    assert page.failures == []
    assert sum(count for said, count in page.said.items() if said.startswith("a step of")) <= 0.1 * page.frames
