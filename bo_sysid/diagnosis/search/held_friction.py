"""Whether friction of the leading sets holds, creeps or preslides."""

from bo_sysid.diagnosis.search.moves import has_friction, leading
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import vary
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.sets.rules import clean, explains_little
from bo_sysid.diagnosis.sets.shapes import with_shapes_unsure

_SIGNIFICANT = 2.0  # standard deviations from which presliding is told from none
_UNDECIDED = 1.005  # times what friction that creeps leaves: one that holds within that may be it
_AS_GOOD = 1.02  # times what presliding leaves: none within that is as good


def prefer_static_friction(final: Search) -> None:
    """Let friction of the leading set hold a load where recordings do not tell that it creeps.

    Machines' friction holds; that of MuJoCo's default settings creeps. What is richer and leaves
    more than friction that creeps is no rival of friction that holds: it stands for the creep.
    """
    leader = leading(final)
    if not any(c.regularised for c in leader.members):
        return
    known = [final.known(c.usual) if c.regularised else c for c in leader.members]
    held = final.fit(known, leader.x, start=leader.start, guess=leader.hypothesis, effort=FINAL)
    if held.rms < _UNDECIDED * leader.rms:
        for f in [f for f in final.fits.values() if f.names == leader.names]:
            creeps = f.effects == leader.effects and any(c.regularised for c in f.members)
            if creeps or (f.width > leader.width and f.rss > leader.rss):
                del final.fits[f.key]


def vary_presliding(final: Search) -> None:
    """Vary the presliding of friction on all windows: in some of them joints may be stuck."""
    leader, smooth = final.best, not final.prepared.problem.machine.impacts
    decided = clean(leader) or explains_little(leader, final.nominal)
    if smooth and has_friction(leader) and not decided:
        vary(final, leader)


def drop_unsupported_presliding(final: Search) -> None:
    """Leave out presliding of the leading set that the recordings do not tell from none."""
    leader = final.best
    if not has_friction(leader, presliding=True):
        return
    spread = with_shapes_unsure(final.prepared.problem, final.frame.Q, leader).spread
    untold = {
        c.key
        for c, s in zip(leader.members, spread, strict=True)
        if c.preslides and c.shapes[-1] < _SIGNIFICANT * s[-1]
    }
    if not untold:
        return
    members = [c.without_presliding if c.key in untold else c for c in leader.members]
    known = [final.known(c) for c in members]
    straight = final.refit(known, leader.x, guess=leader.hypothesis, effort=FINAL)
    if straight.rms > _AS_GOOD * leader.rms:
        return
    for f in list(final.fits.values()):
        if f.effects == leader.effects and any(c.preslides and c.key in untold for c in f.members):
            del final.fits[f.key]
