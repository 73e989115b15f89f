"""Displacement fields measured in images: their strain, and their error where the truth is known."""
