"""Programs that bring the offset to a control over a protocol of the control's own."""
