"""What was captured of a lattice, and how it is compared: distances of points, and records of force sensors with their errors."""
