"""Parameters of mass-spring-dashpot lattices from captured shapes and forces."""
