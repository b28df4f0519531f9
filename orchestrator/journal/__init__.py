"""The write-ahead record of a run, and its reader."""
