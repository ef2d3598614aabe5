"""The outer loop: a policy from few real trajectories, through an identified model.

`bo_sysid.learn.learn.learn` is the loop. Names are imported from the modules themselves; this
package stays light.
"""

import sys
from types import ModuleType
from typing import Any

CHOICES = ("sample", "argmax", "minimum-mean")
"""Names for `learn.choose`; see `bo_sysid.learn.choose`."""

STOPS = ("seed", "zhu", "timeout")
"""Names for `learn.stop`; see `bo_sysid.learn.stops`."""


class _Callable(ModuleType):
    """`from bo_sysid import learn` gives this package, once it has been imported."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        from bo_sysid.learn.learn import learn

        return learn(*args, **kwargs)


sys.modules[__name__].__class__ = _Callable
