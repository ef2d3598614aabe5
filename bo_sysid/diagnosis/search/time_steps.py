"""How finely a search steps: until what a finer time step changes is in proportion to the step."""

from bo_sysid.diagnosis.search.moves import carried, has_friction
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import creep
from bo_sysid.diagnosis.search.window_lengths import TRACTABLE, windows_of
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS
from bo_sysid.diagnosis.windows.windowing import Prepared, meets_impacts, prepare, second_order

GAP_DIVISION = 4
"""By what a time step is divided where a joint moves in a gap."""

_LONG_STEP = 2.0  # [sigma] of the correction above which the simulation steps at half
_LONG_STEP_IN_CONTACT = 0.7  # the same, where no share of a correction says when geoms touch
_HALVINGS, _HALVINGS_IN_CONTACT = 3, 2
_CURVED = 0.05  # share of what is left, by which half a step may miss its share of the correction
_STRAIGHTER = 0.5  # of what half a step missed, that remains at half: by the square it is a quarter
_WORSE = 1.02  # times what was left, from which a finer step is worse
_BRISTLES_DIVISION = 2  # by what a time step is divided where friction preslides
_PRESLIDING_SHOWS = 1.05  # [sigma] of a set that lacks it, from which it is searched so


def short_enough(
    evidence: Evidence, prepared: Prepared, length: int, step: float
) -> tuple[Prepared, float]:
    """Halve the time step until a finer one changes little."""
    most, halvings = _LONG_STEP, _HALVINGS
    if meets_impacts(prepared.problem):
        most, halvings = _LONG_STEP_IN_CONTACT, _HALVINGS_IN_CONTACT
    for _ in range(0 if evidence.simulated else halvings):
        if prepared.correction_rms <= most:
            break
        step = step / 2
        prepared = prepare(windows_of(evidence, length, step))
    return prepared, step


def straightened(
    evidence: Evidence, search: Search, leader: Fit, length: int, step: float
) -> tuple[Search, float]:
    """Carry the best sets to a step whose changes are in proportion to it, up to what is left.

    A servo's step of h k_v / I = .4 bends by .2 sigma, for which a rotor was told with a lag. What
    bends otherwise than by the square of the step, as where dry friction holds, no step mends, and
    a machine that is itself simulated at a step is told best at that.
    """
    if evidence.simulated or meets_impacts(search.prepared.problem):
        return search, step
    finest = float(search.prepared.problem.machine.model.opt.timestep) / 2**_HALVINGS
    while step / 2 >= finest:
        missed = second_order(search.prepared)
        if missed <= _CURVED * max(1.0, leader.rms):
            break
        prepared = prepare(windows_of(evidence, length, step / 2), leader.hypothesis)
        if second_order(prepared) > _STRAIGHTER * missed:
            break
        made = carried(search, prepared)
        if made.best.rms > _WORSE * search.best.rms:
            break
        search, step = made, step / 2
    return search, step


def shows_own_step(search: Search, fit: Fit) -> bool:
    """Whether recordings show a coarser step than was halved to, as those of a simulation.

    The share of what a finer step changes is then as far below none as is looked for. Far from the
    recordings it makes up for anything.
    """
    problem = search.prepared.problem
    own = float(problem.machine.model.opt.timestep)
    halved = problem.windows.timestep < step_for(search, fit, own)
    told = fit.rms < TRACTABLE and not problem.machine.impacts
    return halved and told and fit.hypothesis.numerics <= SHARE_BOUNDS[0]


def finer_step(
    evidence: Evidence, search: Search, leader: Fit, length: int, step: float
) -> tuple[Search, float]:
    """Carry the best sets to a finer step where that tells more.

    That is where a finer step's difference bends (`straightened`), and where it tells how friction
    preslides.
    """
    search, step = straightened(evidence, search, leader, length, step)
    finer = step_for(search, leader, step)
    if finer == step or not _preslides(leader) or leader.rms < _PRESLIDING_SHOWS:
        return search, step
    creep(search, leader)
    if search.best.rms < _PRESLIDING_SHOWS:  # it creeps, at the step of a simulated machine
        return search, step
    return carried_over(evidence, search, leader, length, finer), finer


def step_for(search: Search, leader: Fit, step: float) -> float:
    """Return the time step for a leader whose joints meet ends of gaps between two long steps.

    No share of a finer step's difference corrects that: when it arrives bends what follows. Nor
    does a long step tell friction with presliding from one without.
    """
    problem, division = search.prepared.problem, 1
    if problem.loose(leader.hypothesis):
        division = GAP_DIVISION
    elif _preslides(leader) and not problem.machine.impacts:
        division = _BRISTLES_DIVISION
    return min(step, float(problem.machine.model.opt.timestep) / division)


def _preslides(leader: Fit) -> bool:
    """Whether friction of a fit preslides, or what is left may be its presliding."""
    return leader.rms < ROUGH and has_friction(leader, presliding=leader.rms < _PRESLIDING_SHOWS)


def carried_over(
    evidence: Evidence, search: Search, leader: Fit, length: int, step: float
) -> Search:
    """Carry the best sets to windows of a length in instants and a time step in [s]."""
    return carried(search, prepare(windows_of(evidence, length, step), leader.hypothesis))
