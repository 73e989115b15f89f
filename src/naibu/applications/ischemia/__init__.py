"""Active ischemia: skin that is pressed, and turns pale."""
