"""Linear elasticity and three-element (Jeffreys) viscoelasticity at small strain, and their integration in time."""
