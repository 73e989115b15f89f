"""Unilateral contact with rigid indenters, with friction, for continua and lattices."""
