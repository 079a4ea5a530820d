"""The demo: the service on simulated hardware for days that take seconds, the closed loop, a machine in real time."""
