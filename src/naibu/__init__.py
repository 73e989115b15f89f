"""naibu: from images of the inside of a soft thing to a model that behaves like it."""

__version__ = "0.1.0"
