"""Chapter 4 of the report: mass-spring-dashpot lattices."""
