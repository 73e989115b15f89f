"""Equilibrium at finite strain: elements, laws, supports with contact and friction, linear solvers, and sensitivities."""
