"""Identification: which parameters predict the recordings best, and how sure one can be."""

from bo_sysid.identify.identify import identify
from bo_sysid.identify.result import Identification

__all__ = ["Identification", "identify"]
