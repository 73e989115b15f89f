"""Cuts of triangulated surfaces along the path of a tool."""
