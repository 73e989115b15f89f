"""The live page: a browser that shows a simulation as it runs, and leads its tools."""
