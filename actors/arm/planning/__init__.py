"""The motion of a pour as joint trajectories, with its checks."""
