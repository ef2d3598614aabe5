"""What a log is, before anything is fitted: wiring, clocks, excitation, identifiability, noise."""
