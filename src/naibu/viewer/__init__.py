"""What the reader sees: result pages, and the 3-D scene that they, the live page and the notebook share."""
