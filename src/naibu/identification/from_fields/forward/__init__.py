"""Equilibrium under measured displacement, its load cases, laws, and sensitivities."""
