"""Simulations with lattices: sessions, contact with indenters, loading histories, and their derivatives."""
