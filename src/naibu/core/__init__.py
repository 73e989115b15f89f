"""Data types that all other packages share: volumes, meshes, markers, displacement fields, experiments, parameters, errors."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
