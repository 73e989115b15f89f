"""Markers followed through a sequence of images."""
