"""Records of a run: its events, their write-ahead journal and its check, and the state that they add up to."""
