"""Finite elements: shape functions, hyperelastic laws, assembly, and Dirichlet boundary conditions."""
