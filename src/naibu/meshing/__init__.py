"""Meshes: made from measures, judged, cut at interfaces, and searched for the cell around a point."""
