"""A first study from a model and logs, every guess marked with its reason."""
