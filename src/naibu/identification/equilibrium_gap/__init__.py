"""Moduli from the equilibrium of forces in a measured displacement field: the equilibrium gap method and its weighted form."""
