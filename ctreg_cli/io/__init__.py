"""Files, and nothing but files."""
