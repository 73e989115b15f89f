"""Chapter 3 of the report: identification of non-uniform elasticity."""
