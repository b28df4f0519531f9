"""The write-ahead record of a run, its checks and its readers."""
