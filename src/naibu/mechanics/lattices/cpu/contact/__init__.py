"""Steps of lattices in contact with indenters: faces pressed on by them, friction, and the equations of a step."""
