"""What makes the reference runs with version 0.1.0 only, so it is not even imported by another one."""

collect_ignore = ["make.py", "scenes.py", "machine.py", "models.py", "tables.py"]
