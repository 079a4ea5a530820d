"""Simulated machine and devices: an independent witness for tests and the demo."""
