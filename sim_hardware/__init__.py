"""Simulated machine and devices: an independent reference for tests and the demo."""
