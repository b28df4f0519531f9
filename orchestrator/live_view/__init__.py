"""The Rerun live view: recordings, viewers and their servers."""
