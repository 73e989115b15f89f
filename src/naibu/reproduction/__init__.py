"""Reproduction of the tables and figures of the 2008 report :cite:p:`hirai2008`, one package per chapter."""
