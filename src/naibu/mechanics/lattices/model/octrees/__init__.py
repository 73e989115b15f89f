"""Lattices of octrees, and what makes them respond as regular ones."""
