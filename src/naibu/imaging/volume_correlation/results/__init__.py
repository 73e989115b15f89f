"""What a fit states: displacement, covariance, strain, and the points that models are fitted to."""
