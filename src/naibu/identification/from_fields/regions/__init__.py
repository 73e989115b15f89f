"""Regions of a map of moduli: segmentation, and borders that run through cells."""
