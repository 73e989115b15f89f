"""Soft fingertip with a sensing chip at the centre of its base: mechanics of pressing, readings, and forces decoded from them."""
