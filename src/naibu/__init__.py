"""naibu: from images of the inside of a soft thing to a model that behaves like it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from naibu._version import __version__

if TYPE_CHECKING:
    from naibu import datasets
    from naibu.workflows.identify import compare, identify, load_experiment, predict, report

__all__ = ["__version__", "compare", "datasets", "identify", "load_experiment", "predict", "report"]

# loaded when first used, by name, so that `import naibu` stays light
_MODULES = {"datasets": "naibu.datasets"} | dict.fromkeys(
    ("compare", "identify", "load_experiment", "predict", "report"), "naibu.workflows.identify"
)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'naibu' has no attribute {name!r}; it has {', '.join(__all__)}")
    module = importlib.import_module(_MODULES[name])
    return module if name == "datasets" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
