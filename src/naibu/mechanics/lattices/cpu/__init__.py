"""The engine of lattices on the processor."""
