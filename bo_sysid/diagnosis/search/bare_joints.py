"""What a model of bare joints lacks: friction, damping and rotors, all three at every joint.

Robots' descriptions are often written without any of them, and leave thousands of sigma. A search
that adds one effect or group after the other goes astray there: in windows short enough for slopes,
a motor of a tenth of its strength does what a missing rotor does, and no exchange leads back.
"""

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import TRACTABLE, next_length, windows_of
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import LOOSE
from bo_sysid.diagnosis.sets.subsets import groups
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.windowing import prepare

_LACKED = ("dry_friction", "viscous_damping", "armature")
_JOINTS = 3  # from which pairs and triples of single effects do not reach such a set
_STARTS = (3.0, 10.0, 1.0, 30.0)  # times what shows, from which it is fitted in turn
_EXPLAINED = 0.05  # of what the nominal model leaves, that the set may leave


def from_bare_joints(
    evidence: Evidence, search: Search, length: int, horizon: int, step: float
) -> Search | None:
    """Return a search on full windows in which what bare joints lack is fitted.

    Joints are geared by little or by much, and a fit from the wrong size ends beside the truth: it
    begins from several, until one comes near. None where not even the shortest windows are too long
    for slopes, or where the best fit leaves too much.

    Args:
        evidence: what is searched.
        search: on the shortest windows.
        length: of those in instants.
        horizon: of full ones.
        step: of the simulation in [s].
    """
    members = bare_joints(search)
    if not members or search.nominal.rms < TRACTABLE:
        return None
    best: Search | None = None
    for factor in _STARTS:
        x = [np.minimum(factor * np.asarray(c.probe), c.high) for c in members]
        made = Search.on(search.prepared, search.candidates, search.most, None, search.doing)
        made = _carried(evidence, made, made.fit(members, x), length, horizon, step)
        best = made if best is None or made.least < best.least else best
        if best.least < LOOSE:
            break
    return best if best is not None and best.least < _EXPLAINED * best.nominal.rms else None


def _carried(
    evidence: Evidence, search: Search, fit: Fit, length: int, horizon: int, step: float
) -> Search:
    """Carry a fit from short windows to full ones, its magnitudes and starts with it."""
    while length < horizon:
        length = next_length(length, horizon)
        prepared = prepare(windows_of(evidence, length, step), fit.hypothesis)
        search = Search.on(prepared, search.candidates, search.most, fit.hypothesis, search.doing)
        fit = search.fit(fit.members, fit.x, guess=fit.hypothesis)
    return search


def bare_joints(search: Search) -> tuple[Candidate, ...]:
    """Return what bare joints lack; nothing where joints are few or sets may not be as large."""
    units = {u.group: u.members for u in groups(search.candidates) if u.group in _LACKED}
    few = any(len(members) < _JOINTS for members in units.values())
    if few or len(units) < len(_LACKED) or len(units) > search.most:
        return ()
    return tuple(search.candidates[i] for effect in _LACKED for i in units[effect])
