"""Objects whose parts slide on each other, or on a plate that they lie on."""
