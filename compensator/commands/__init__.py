"""Commands that are more than a few lines: one file each, called by `compensator.cli`."""
