"""Child processes and the lifetime of Ray."""
