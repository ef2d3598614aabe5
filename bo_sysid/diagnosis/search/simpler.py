"""Whether a part of the leading set is enough, once the time step is corrected there."""

from dataclasses import replace

from bo_sysid.diagnosis.search.final import compare, fitted_on_all
from bo_sysid.diagnosis.search.moves import leading
from bo_sysid.diagnosis.search.polish import CURVED, polished
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import admissible, ranked
from bo_sysid.diagnosis.windows.windowing import prepare

_NEAR = 1.05  # times what the leader leaves, that a part of it leaves at most
_RIVALS = 5  # sets beside it that are fitted anew


def at_a_part(final: Search) -> Search:
    """Return the final fits prepared at a part of the leading set, where that leads then.

    What a finer time step changes is taken at the leader. At a set with fewer members it is not the
    same, above all where something resonates: with the leader's, a soft gear and a late encoder
    left 1.038 σ of an arm that had both, and 1.005 with their own. Two lags stood for the rest.

    Args:
        final: the fits on all windows, compared.
    """
    leader, prepared = leading(final), final.prepared
    part = _nearest_part(final, leader)
    if part is None or prepared.correction_rms < CURVED or prepared.problem.machine.impacts:
        return final
    problem = replace(prepared.problem, correction=None)
    part, own = polished(problem, part, prepare(problem, part.hypothesis), final.doing)
    if len(own.problem.windows) < len(problem.windows):  # fits to other windows do not compare
        return final
    made = Search.on(own, final.candidates, final.most, part.hypothesis, final.doing)
    rivals = ranked(final.fits.values(), final.prior)[:_RIVALS]
    for f in {f.key: f for f in (*rivals, leader, part)}.values():
        if f.members:
            fitted_on_all(made, f)
    if leading(made).names != part.names:
        return final
    compare(made, part)
    return made


def _nearest_part(final: Search, leader: Fit) -> Fit | None:
    """Return the set inside the leader that leaves least, where that is little more."""
    fits = list(final.fits.values())
    parts = [
        f
        for f in fits
        if f.members
        and f.names < leader.names
        and f.rms < _NEAR * leader.rms
        and admissible(f, final.nominal, fits)
    ]
    return min(parts, key=lambda f: f.rms, default=None)
