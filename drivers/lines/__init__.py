"""Transport: lines shared by devices."""
