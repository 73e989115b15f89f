"""What a calibrated model predicts, how sure it is, and how it compares with simpler descriptions."""
