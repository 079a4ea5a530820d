"""The loop of the service: diagnosis, shadow, adoption, and back."""
