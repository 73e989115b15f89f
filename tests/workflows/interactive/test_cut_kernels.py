"""What cuts need is compiled before the first one, and the page waits for it."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest
from browser import CHROMIUM, opened_browser
from served_models import served

from naibu.core.errors import InputError
from naibu.viewer.live.commands import LiveCommand
from naibu.workflows.interactive import cut_kernels
from naibu.workflows.interactive.cut_kernels import CutKernels

# kernels that a cut of the demonstration, and steps behind it, load or compile beside those of the small body
PROGRAM = """
import gc
from numba.core.dispatcher import Dispatcher
from naibu.simulation import InteractiveSimulation
from naibu.workflows import tools_for, touchable
from naibu.workflows.interactive.cut_kernels import compile_for_cuts
from naibu.workflows.interactive.preparation import compile_for

def known():
    kernels = [o for o in gc.get_objects() if isinstance(o, Dispatcher) and o.py_func.__module__.startswith("naibu")]
    return {(k.py_func.__module__, k.py_func.__name__, str(s)) for k in kernels for s in k.signatures}

body = touchable("demo").body
compile_for(body)
compile_for_cuts()
before = known()
low, high = body.points.min(axis=0), body.points.max(axis=0)
middle = 0.5 * (low + high)
simulation = InteractiveSimulation(body, tools_for(body))
simulation.cut([[[middle[0], y, high[2] + 9.0], [middle[0], y, middle[2]]] for y in (low[1] - 9.0, high[1] + 9.0)])
simulation.take("sphere")
simulation.move(high * [0.0, 0.0, 1.0])
while not simulation.advance().force.any():
    pass
print(len(before), sorted(known() - before))
"""


@pytest.mark.slow
def test_a_small_cut_brings_all_kernels_of_a_large_one() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    count, new = done.stdout.split(maxsplit=1)
    assert int(count) > 30
    assert new.strip() == "[]"


def test_cuts_are_refused_until_their_kernels_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()
    monkeypatch.setattr(cut_kernels, "compile_for_cuts", lambda friction: goes_on.wait(60))
    kernels = CutKernels()
    with served() as (_, simulation):
        simulation.cut_kernels = kernels
        across = (((-9.0, -9.0, 20.0), (-9.0, 90.0, 20.0)), ((90.0, -9.0, 20.0), (90.0, 90.0, 20.0)))
        simulation.command(LiveCommand("cut", edges=across))
        said = ""
        while not said:
            said = simulation.trouble()
        assert "still being compiled" in said
        assert simulation.frame().topology == 0
        goes_on.set()
        kernels.wait()
        simulation.command(LiveCommand("cut", edges=across))
        while simulation.frame().topology == 0:
            assert not simulation.trouble()


def test_kernels_that_cannot_be_made_do_not_keep_from_cutting(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(friction: float) -> None:
        raise InputError("no balance")

    monkeypatch.setattr(cut_kernels, "compile_for_cuts", fails)
    kernels = CutKernels(0.3)
    kernels.wait()
    assert kernels.ready


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_the_page_says_that_cutting_is_being_prepared(monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()
    monkeypatch.setattr(cut_kernels, "compile_for_cuts", lambda friction: goes_on.wait(60))
    button = "document.querySelector('[data-mode=cut]')"
    with served() as (address, simulation), opened_browser() as page:
        simulation.cut_kernels = CutKernels()
        page.open(address)
        page.wait(f"{button} && {button}.disabled && {button}.textContent === 'Cut (being prepared)'", 60)
        assert not page.value("document.querySelector('[data-mode=pull]').disabled")
        goes_on.set()
        page.wait(f"!{button}.disabled && {button}.textContent === 'Cut'", 30)
        assert page.console == []
