"""Policies: a Gaussian network, TRPO, batched roll-outs, and files of learned policies.

Names are imported from the modules themselves; those that need torch import it.
"""
