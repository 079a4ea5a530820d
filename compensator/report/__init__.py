"""Pages: HTML, PDF and PNG."""
