"""Sparse linear systems of elasticity: block matrices, direct and iterative solvers, multigrid, and the choice among them."""
