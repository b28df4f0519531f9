"""Studies as written in files."""
