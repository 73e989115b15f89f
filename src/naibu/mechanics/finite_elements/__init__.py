"""Finite elements: shape functions, hyperelastic laws, assembly, and what is prescribed on the boundary."""
