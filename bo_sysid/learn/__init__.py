"""The outer loop: a policy from few real trajectories, through an identified model.

`bo_sysid.learn.learn.learn` is the loop. Names are imported from the modules themselves; this
package stays light.
"""

CHOICES = ("sample", "argmax", "minimum-mean")
"""Names for `learn.choose`; see `bo_sysid.learn.choose`."""

STOPS = ("seed", "zhu", "timeout")
"""Names for `learn.stop`; see `bo_sysid.learn.stops`."""
