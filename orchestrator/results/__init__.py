"""The result of a run, and everything that renders it."""
