"""Uses of mechanics and imaging: the silicon chip that senses force and moment, and skin that turns pale."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
