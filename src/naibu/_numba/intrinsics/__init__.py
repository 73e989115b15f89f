"""Vectors (`simd`), atomic operations (`atomics`) and arguments in memory (`packed_tuples`) in kernels, each with its plain substitute."""
