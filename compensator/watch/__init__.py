"""Observes running services, one machine or a shop: terminal, live page, Foxglove, recorder."""
