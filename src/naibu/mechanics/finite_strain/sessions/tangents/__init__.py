"""Tangents that sessions keep, correct and condense."""
