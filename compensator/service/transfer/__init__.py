"""Bumpless transfer: another compensation continues where one ended, and the published offset does not jump.

At a restart the predecessor is on disk, at `adopt` and `back` it is running. Either way the successor gets a state
(from the last file where nothing has changed, else from a warm-up on the recordings, see `candidate`) and then
continues from the predecessor's `Handover`: its offset and its holds.
"""
