"""Mammography: where a point of one view of a compressed breast lies in the other view, and in the breast."""
