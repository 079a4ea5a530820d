"""JSON Schemas of the messages; `python -m compensator.schemas` writes them anew from the classes."""
