"""Trajectories to record: within limits, as informative as possible."""
