"""Displacement voxel by voxel: block matching, optical flow, and both combined."""
