"""Experiments as folders: a description in TOML and a table of markers for each state."""
