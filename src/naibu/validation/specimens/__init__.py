"""Virtual specimens with known parameters."""
