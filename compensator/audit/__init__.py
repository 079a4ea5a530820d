"""Proves a recording: whole, unchanged, and what the engine makes of its raw samples again, to the bit."""
