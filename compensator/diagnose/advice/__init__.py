"""What to measure and to test next."""
