"""The product on simulated hardware: days that take seconds, the loop closed, and a machine that runs on."""
