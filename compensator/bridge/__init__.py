"""Bridges: the offset to a control over the control's own protocol."""
