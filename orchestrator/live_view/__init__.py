"""The live view: Rerun recordings, viewers and their servers."""
