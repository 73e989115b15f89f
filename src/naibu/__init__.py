"""naibu: from images of the inside of a soft thing to a model that behaves like it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from naibu._version import __version__

if TYPE_CHECKING:
    from naibu import datasets
    from naibu.workflows.compare import compare
    from naibu.workflows.experiments import load_experiment
    from naibu.workflows.identify import identify
    from naibu.workflows.predict import predict
    from naibu.workflows.report import report

__all__ = ["__version__", "compare", "datasets", "identify", "load_experiment", "predict", "report"]

# loaded when first used, by name, so that `import naibu` stays light
_MODULES = {
    "compare": "naibu.workflows.compare",
    "datasets": "naibu.datasets",
    "identify": "naibu.workflows.identify",
    "load_experiment": "naibu.workflows.experiments",
    "predict": "naibu.workflows.predict",
    "report": "naibu.workflows.report",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'naibu' has no attribute {name!r}; it has {', '.join(__all__)}")
    module = importlib.import_module(_MODULES[name])
    return module if name == "datasets" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
