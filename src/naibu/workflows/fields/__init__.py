"""Identification from displacement fields, and what is done with the models that it finds."""
