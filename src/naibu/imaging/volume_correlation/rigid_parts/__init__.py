"""Rigid motion: of the whole before the fit, and of inclusions in it."""
