"""Haptic devices: local models of contact, coupling, limits of force, and the loop that a device turns."""
