"""Cuts of live bodies: computed in the background, their sides, and lattices along the faces of their cubes."""
