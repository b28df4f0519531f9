"""What has been run on this machine, and what was poured: an index over the runs' own journals."""
