"""Multigrid: smoothed aggregation, its cycles, and the solver that uses them."""
