"""Device drivers: protocols of thermocouple modules and displacement controllers."""
