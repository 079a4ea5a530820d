"""Bumpless transfer: another compensation continues where one ended, and the published offset does not jump.

At a restart the predecessor is on disk; at `adopt` and `back` it is running. In both cases the successor gets a state
(from the last file if nothing has changed, otherwise from a warm-up on the recordings, see `candidate`) and then
continues from the predecessor's `Handover`: its offset and its holds.
"""
