"""Parameter sweeps of studies: design, runs, page."""
