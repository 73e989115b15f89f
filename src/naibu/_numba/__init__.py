"""All that naibu uses of Numba beyond its public interface: a cache of kernels by content."""
