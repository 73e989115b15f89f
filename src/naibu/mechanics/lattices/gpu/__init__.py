"""The engine of lattices on a graphics processor (NVIDIA Warp)."""
