"""Chapter 3: identifying non-uniform elasticity."""
