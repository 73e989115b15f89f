"""What a lattice consists of: nodes, elements, parameters, octrees, its surface and its state."""
