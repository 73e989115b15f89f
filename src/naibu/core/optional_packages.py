"""Optional dependencies, imported on demand."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from naibu.core.errors import MissingDependencyError


def optional_package(name: str, purpose: str, install: str | None = None) -> Any:
    """Import an optional package, or raise an error that states what needs it and how to install it.

    Parameters
    ----------
    name : str
        Import name of the package.
    purpose : str
        What needs it, as the subject of a sentence: ``"reading NIfTI files"``.
    install : str, optional
        Name for pip, or the extra that includes it; by default `name`.

    Returns
    -------
    module
        The imported package.

    Raises
    ------
    MissingDependencyError
        The package is not installed, or cannot be loaded.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f'{purpose} needs {name} ({error}); run: pip install "{install or name}"') from error
    except (OSError, ValueError, AttributeError, RuntimeError) as error:  # compiled for another NumPy, or its libraries are not there
        raise MissingDependencyError(
            f"{purpose} needs {name}, which is installed but cannot be loaded ({error}); install a build of it for NumPy {np.__version__}"
        ) from error
