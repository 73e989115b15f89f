"""Uses of mechanics and imaging: a silicon chip that senses force and moment, skin that turns pale, two views of a compressed breast."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
