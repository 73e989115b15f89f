"""Global digital volume correlation (DVC) on cubic B-splines, with covariance."""
