"""naibu: from images of the inside of a soft object to a calibrated mechanical model."""

import lazy_loader

from naibu._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
