"""Intervals of lattice parameters: profile likelihood where residuals are smooth, regression through jumps in contact."""
