"""From tables of markers to calibrated models: import, identify, cross-validation, comparison of models."""
