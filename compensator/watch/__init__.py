"""Observes the running services of one machine or a shop: terminal, live page, Foxglove, recorder."""
