"""The result in words, and as `diagnosis.json`."""
