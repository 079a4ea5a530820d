"""What of the findings is deployed, the verdict, and the result."""
