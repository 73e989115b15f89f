"""Static equilibrium and viscoelastic motion at finite strain, with exact sensitivities."""
