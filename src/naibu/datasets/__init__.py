"""The bundled measurements: markers inside gels before and after loading, as printed in the 2008 report :cite:p:`hirai2008`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
