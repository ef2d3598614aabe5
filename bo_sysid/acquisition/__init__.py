"""Which candidate to evaluate next: arg-min entropy and its rivals, by name.

    acquisition = build_acquisition("argmin-entropy", SelectionContext(...))
    row = pick(acquisition, candidates, evaluated)

Names can be listed and checked without importing torch.
"""

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.registry import (
    acquisition_names,
    build_acquisition,
    register_acquisition,
)

__all__ = ["SelectionContext", "acquisition_names", "build_acquisition", "register_acquisition"]
