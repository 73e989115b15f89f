"""Chapter 1: measuring the motion inside an object."""
