"""Where simulation and recording differ: name the missing physics, put it into the model."""
