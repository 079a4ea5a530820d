"""JSON Schemas of the messages; `python -m compensator.schemas` generates them from the classes."""
