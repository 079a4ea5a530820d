"""The functions for notebooks, scripts and commands, and their results."""
