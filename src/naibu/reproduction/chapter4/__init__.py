"""Chapter 4: lattices in real time."""
