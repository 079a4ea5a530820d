"""The service: sampling, guards, compensation, limits, recording, publishing, the loop."""
