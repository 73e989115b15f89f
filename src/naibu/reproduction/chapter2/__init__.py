"""Chapter 2 of the report: simulation and measurement of viscoelastic deformation."""
