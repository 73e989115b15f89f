"""Cutting of meshes along the surface that a blade sweeps."""
