"""Calibration of lattices from recorded shapes and forces: the verb, its example, its page."""
