"""Feature points: detection, matching by correlation and relaxation labelling, interpolation between them."""
