"""Calibration of a lattice study: its model, its unknowns, its problem."""
