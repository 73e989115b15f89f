"""Moduli zone by zone or cell by cell from displacement fields (FEMU), with regularization, segmentation and covariance."""
