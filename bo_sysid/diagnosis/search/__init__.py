"""From windows to the decision: sets are proposed in rounds, carried to longer windows, fitted."""
