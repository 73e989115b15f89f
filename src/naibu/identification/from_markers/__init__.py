"""Finite element model updating (FEMU) from markers: model of the specimen, residuals, Gauss-Newton search."""
