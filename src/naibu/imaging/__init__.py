"""Displacement inside volumes: digital volume correlation, optical flow, feature and marker tracking, rigid registration."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
