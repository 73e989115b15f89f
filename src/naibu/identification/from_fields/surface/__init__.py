"""What seeking the motion of loaded nodes does to moduli: bias of its prior and of noise, noise that looks like information, skewness."""
