"""Minimization for moduli inside a body: Gauss-Newton and truncated Newton, regularization and its weight."""
