"""Identification: which parameters predict the recordings best, and how sure one can be."""

import sys
from types import ModuleType

from bo_sysid.identify.identify import identify
from bo_sysid.identify.result import Identification

__all__ = ["Identification", "identify"]


class _Callable(ModuleType):
    """`from bo_sysid import identify` gives this package, once it has been imported."""

    __call__ = staticmethod(identify)


sys.modules[__name__].__class__ = _Callable
