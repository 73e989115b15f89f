"""Kernels of linear-implicit steps: in parts for threads, with conjugate gradients and their coarse space."""
