"""A Ray cluster that others have started: whether it will do, who is in it, and what stands on which machine."""
