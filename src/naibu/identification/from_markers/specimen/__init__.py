"""The specimen as a finite-element model of its parameters: mesh, boundary conditions, alignment with the scan."""
