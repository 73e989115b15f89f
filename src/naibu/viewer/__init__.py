"""HTML pages of results: identification, prediction, simulated motion, image slices and reproduced chapters."""
