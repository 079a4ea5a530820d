"""Thermal error compensation for machine tools."""
