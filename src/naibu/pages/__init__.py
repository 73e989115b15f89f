"""Pages of tables and figures: what is on them, and how they become HTML and JSON."""
