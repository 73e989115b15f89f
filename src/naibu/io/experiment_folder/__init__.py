"""Experiment folders: a description in TOML and one marker table per state."""
