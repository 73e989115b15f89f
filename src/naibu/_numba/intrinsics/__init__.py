"""Kernels: vectors (`simd`), atomic operations (`atomics`), no subnormal numbers (`subnormals`), arguments in memory (`packed_tuples`)."""
