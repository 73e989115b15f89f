"""Packages that are absent, and packages that are installed but broken, are told apart in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from naibu.core.errors import MissingDependencyError
from naibu.core.optional_packages import optional_package


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("raise ValueError('numpy.dtype size changed')", r"installed but cannot be loaded \(numpy.dtype size changed\)"),
        ("import ctypes\nctypes.CDLL('libthat_is_nowhere.so')", r"installed but cannot be loaded \(libthat_is_nowhere.so"),
        ("import a_package_that_is_nowhere", r'No module named .a_package_that_is_nowhere.\); run: pip install "extra"'),
    ],
)
def test_what_cannot_be_imported_is_told_with_its_reason(body: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "broken_package"
    (tmp_path / f"{name}.py").write_text(body + "\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependencyError, match=rf"a test needs {name}.*{told}"):
        optional_package(name, "a test", "extra")
