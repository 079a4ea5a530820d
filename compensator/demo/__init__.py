"""The product on simulated hardware: days that take seconds, the closed loop, and a machine in real time."""
