"""Undeclared effects."""
