"""Recordings: MCAP files, their hash chain and signatures, the live file, the recorder."""
