"""Data: tables, records and runs, and what is refused."""
