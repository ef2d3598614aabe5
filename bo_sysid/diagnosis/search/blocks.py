"""Cross-validation through the simulator, of sets that are far from the recordings."""

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.cross_validation import cross_validated
from bo_sysid.diagnosis.sets.rules import admissible, ranked
from bo_sysid.diagnosis.windows.problem import ROUGH


def simulate_blocks(search: Search) -> None:
    """Simulate what sets leave of each block of windows, where slopes do not reach to it.

    Far from the recordings, of sets whose every member is needed, and but for those that leave more
    of all blocks than another does of blocks that it was not fitted to, which slopes foretell of
    one that is near. Not in contact, where every window is fitted by itself and five more fits of
    each set would take as long as the search.
    """
    if search.prepared.problem.machine.impacts:
        return
    fits = tuple(search.fits.values())
    able = [f for f in ranked(fits, search.prior) if admissible(f, search.nominal, fits)]
    near = min((f.cv.sum() for f in able if f.rms <= ROUGH), default=np.inf)
    for f in able:
        rivals = (g.cv.sum() for g in search.fits.values() if g.simulated)
        if f.rms > ROUGH and not f.simulated and f.rss < min(near, min(rivals, default=np.inf)):
            search.doing(f"sets that leave {f.rms:.1f} sigma are fitted without each fifth block")
            search.fits[f.key] = cross_validated(search.frame, f)
