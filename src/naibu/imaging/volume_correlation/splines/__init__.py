"""Displacements as cubic B-splines: the grid, and normal equations on it."""
