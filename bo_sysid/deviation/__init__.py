"""How far the model's predictions are from what was recorded.

`DeviationProblem` needs torch and is imported from `bo_sysid.deviation.problem`.
"""

from bo_sysid.deviation.measure import Blocks, Deviation, Evaluation, Whitening
from bo_sysid.deviation.starts import fit_starts

__all__ = ["Blocks", "Deviation", "Evaluation", "Whitening", "fit_starts"]
