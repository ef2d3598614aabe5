"""Arms compared: acquisition, choice of model and stop rule, on problems, with paired seeds.

`bo_sysid.compare.compare.compare` is the comparison. Names are imported from the modules
themselves; this package stays light.
"""
