"""Haptic devices at the live simulation: packets, the endpoint on the loopback interface, and a simulated device."""
