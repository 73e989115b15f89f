"""Viscoelastic parameters from displacement histories."""
