"""Bisection forests of triangles and tetrahedra: local refinement and coarsening, transfer of states, marking."""
