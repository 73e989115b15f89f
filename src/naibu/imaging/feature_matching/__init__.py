"""Feature matching: Harris points, normalised cross-correlation, relaxation labelling, Delaunay interpolation."""
