"""Mass-spring models of scanned surfaces, and how their cuts open under tension."""
