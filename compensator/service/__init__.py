"""The service: sampling, guards, compensation, limits, recording, publishing, the search for better models."""
