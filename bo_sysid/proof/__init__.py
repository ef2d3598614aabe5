"""Proof on concealed data: draw machines that lack physics, have them diagnosed, then look."""
