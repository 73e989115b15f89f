from __future__ import annotations

import gc
import os
import pickle
import shutil
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits
from virtual_press import COARSE, KNOWN, Press, virtual_press, write_press

from naibu._numba.process_lock import ProcessLock
from naibu.workflows.markers import identify

LONGEST_WAIT_S = 900.0
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
# Files that one worker begins with while another compiles what most others need, and those of few tests that take long: a worker that gets
# one of them last works alone for as long.
FIRST = ("test_warm_up.py", "test_house.py")
LONG = (
    "test_assumed_law.py",
    "test_border_refinement.py",
    "test_contradicting_experiments.py",
    "test_correlate_blocks.py",
    "test_layered_leg.py",
    "test_live_fingertip.py",
    "test_mammography.py",
    "test_mesh_error.py",
    "test_other_readings.py",
    "test_particles_to_stiffness.py",
    "test_same_result.py",
    "test_self_test.py",
    "test_sense_blocks_cluster.py",
    "test_sensing_chain.py",
    "test_sensing_chip.py",
)


def pytest_configure() -> None:
    """Let linear algebra have one thread in each worker, and in what tests start, unless the user wants it otherwise.

    Workers fill the cores: threads of small matrices would wait for one another by computing. Kernels have their threads all the same;
    these wait asleep.
    """
    if not any(variable in os.environ for variable in THREADS):
        os.environ.update(dict.fromkeys(THREADS, "1"))
        threadpool_limits(1, user_api="blas")  # what is loaded already
    # each worker has as many of them as there are cores: they would spin on cores that others need
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Search for no cycles while tests are collected, and leave what was collected, half a million objects, out of later searches."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files in the order in which workers take them: those of `FIRST`, those of `LONG`, then those of most tests."""
    count = Counter(item.path for item in items)
    rank = dict.fromkeys(FIRST, -2) | dict.fromkeys(LONG, -1)
    place = {path: (rank.get(path.name, 0), -count[path], k) for k, path in enumerate(count)}
    items.sort(key=lambda item: place[item.path])


@pytest.fixture(scope="session")
def press(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Press:
    """The same for all workers: the first one that needs it makes it, in a folder of the whole run."""
    shared = tmp_path_factory.getbasetemp()
    if hasattr(request.config, "workerinput"):
        shared = shared.parent
    root, kept = shared / "press", shared / "press.pickle"
    with ProcessLock(shared / "press.lock", LONGEST_WAIT_S):
        if not kept.exists():
            folder = write_press(root / "press", virtual_press(), ("pressed", "pressed_more"))
            results = root / "results"
            found = identify.identify(folder, known=KNOWN, settings=COARSE, states={"press": ["pressed"]}, out=results)
            kept.write_bytes(pickle.dumps(Press(folder, results, found)))
    made: Press = pickle.loads(kept.read_bytes())
    return made


@pytest.fixture
def experiment_folder(press: Press, tmp_path: Path) -> Path:
    """A copy of the press that a test may damage."""
    return Path(shutil.copytree(press.folder, tmp_path / "press"))
