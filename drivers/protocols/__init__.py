"""Protocols: frames and texts as pure functions, without any input or output."""
