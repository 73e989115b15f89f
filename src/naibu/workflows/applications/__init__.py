"""Verbs of applications: sensing chips, skin, breasts."""
