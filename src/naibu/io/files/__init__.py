"""Atomic writing of files, and provenance records of input files."""
