"""Closed forms, virtual specimens and measures with which results are judged."""
