"""Looks at running services, one machine or a shop: terminal, live page, Foxglove, a recording of everything."""
