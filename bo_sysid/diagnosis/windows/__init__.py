"""Recordings in windows, and what a hypothesis predicts for them."""
