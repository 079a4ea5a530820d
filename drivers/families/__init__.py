"""Device families: one file for each."""
