"""Displacement from scans: volume correlation, marker tracking, comparison of methods."""
