"""The search for effects: scan, criterion, exchange, and what is found in some evidence."""
