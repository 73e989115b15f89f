"""Finite elements at small and finite strain, contact with rigid indenters, and mass-spring-dashpot lattices."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
