"""Motion of the arm: profiles in time, lines in space, and the mover that follows them cycle by cycle."""
