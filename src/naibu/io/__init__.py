"""Read and write experiments, tables and results."""
