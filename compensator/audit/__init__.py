"""Audits recordings: complete, unchanged, and reproduced bit for bit from the raw samples."""
