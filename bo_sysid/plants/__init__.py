"""What trajectories are collected from: vectorised tasks, environments, and plants that count.

Names are imported from the modules themselves; this package stays light.
"""
