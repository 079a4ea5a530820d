"""Transfer functions, the thermal model and its file, the streaming engine, effects."""
