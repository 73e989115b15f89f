from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from virtual_press import COARSE, KNOWN, Press, virtual_press, write_press

from naibu.workflows import identify


@pytest.fixture(scope="session")
def press(tmp_path_factory: pytest.TempPathFactory) -> Press:
    root = tmp_path_factory.mktemp("press")
    folder = write_press(root / "press", virtual_press(), ("pressed", "pressed_more"))
    results = root / "results"
    found = identify.identify(folder, known=KNOWN, settings=COARSE, states={"press": ["pressed"]}, out=results)
    return Press(folder, results, found)


@pytest.fixture
def experiment_folder(press: Press, tmp_path: Path) -> Path:
    """A copy of the press that a test may damage."""
    return Path(shutil.copytree(press.folder, tmp_path / "press"))
