"""What the base model leaves of measured Y, and what of it no effect causes."""
