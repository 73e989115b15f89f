"""Fiducial markers and particles: detection, localisation, matching between states, tracking in sequences."""
