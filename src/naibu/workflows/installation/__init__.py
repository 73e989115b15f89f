"""Examination and preparation of an installation."""
