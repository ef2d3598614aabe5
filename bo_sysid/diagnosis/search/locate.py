"""From recordings to the decision: windows that grow, the search, the final fits on all windows."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from bo_sysid.diagnosis.search.bare_joints import from_bare_joints
from bo_sysid.diagnosis.search.beginnings import unexplained_start
from bo_sysid.diagnosis.search.blocks import simulate_blocks
from bo_sysid.diagnosis.search.final import compare, final_fits
from bo_sysid.diagnosis.search.gaps import replace_by_backlash
from bo_sysid.diagnosis.search.held_friction import prefer_static_friction
from bo_sysid.diagnosis.search.moves import carried, explore, without_weakest
from bo_sysid.diagnosis.search.noisy_inputs import noisy_inputs
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.sharpen import sharpened
from bo_sysid.diagnosis.search.simpler import at_a_part
from bo_sysid.diagnosis.search.time_steps import (
    GAP_DIVISION,
    carried_over,
    finer_step,
    short_enough,
    shows_own_step,
    step_for,
    straightened,
)
from bo_sysid.diagnosis.search.window_lengths import (
    LEAST,
    contact_decides,
    limit_by_growth_rate,
    limit_by_input_noise,
    limit_by_residual,
    most_informative,
    next_length,
    show_more,
    windows_of,
)
from bo_sysid.diagnosis.sets.decide import Decision, decide
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.meshing import backlash_suspects
from bo_sysid.diagnosis.sets.rules import clean, explains_little, follows_anything
from bo_sysid.diagnosis.sets.shifted import same_but_late
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.windowing import Prepared, meets_impacts, prepare

_LONGER = 1.3  # times as long, that makes windows worth lengthening once more


@dataclass(frozen=True)
class Located:
    """The decision, with the windows on which it was made.

    Attributes:
        decision: the posterior over sets.
        prepared: all training windows.
        search: the finished search, for what is asked of it later.
        evidence: what it was made from.
    """

    decision: Decision
    prepared: Prepared
    search: Search
    evidence: Evidence


def locate(
    evidence: Evidence,
    on_stage: Callable[[str], None] = lambda text: None,
    doing: Callable[[str], None] = lambda text: None,
) -> Located:
    """Find the set of effects that explains the training recordings.

    Far from them no set with a joint that it added is an answer (`follows_anything`): where one
    leads, or led in the search, it is looked for without such joints. Recordings of a simulation
    may show the model's own time step: no finer one is taken then.

    Args:
        evidence: what it is found from.
        on_stage: is called when a stage is done.
        doing: is called after every fit: how far a stage is.
    """
    if contact_decides(evidence):
        evidence = evidence.with_impacts()
        doing("a contact that lasts decides by chance: windows are short")
    located = _located(evidence, on_stage, doing)
    if by_added_joints(located):
        on_stage(f"without added joints: {_in_words(located.search.best)}")
        evidence = evidence.rigid
        located = _located(evidence, on_stage, doing)
    leaders = (located.search.best, located.decision.best)
    if any(shows_own_step(located.search, f) for f in leaders):
        on_stage("at the model's own time step, which the recordings show")
        coarser = _located(replace(evidence, simulated=True), on_stage, doing)
        if not by_added_joints(coarser):
            located = min(located, coarser, key=lambda one: one.decision.best.rms)
    return located


def by_added_joints(located: Located) -> bool:
    """Whether joints that a set added decided, far from the recordings.

    What leads may not be what is answered, whose members must be needed. Nor need either have such
    a joint where the set has for which the windows were prepared: where that joint begins is free
    in all of them then. Nothing at all left 6 sigma there of a servo's friction, and 55 without.
    """
    leading, answered = located.search.best, located.decision.best
    if follows_anything(leading) or follows_anything(answered):
        return True
    prepared_for = located.search.frame.hypothesis
    return leading.rms > ROUGH and any(c.effect.hidden for c in prepared_for.members)


def _located(
    evidence: Evidence, on_stage: Callable[[str], None], doing: Callable[[str], None]
) -> Located:
    """Search in windows that grow, fit the leading sets on all of them, and decide."""
    evidence, search, horizon, step = _searched(evidence, on_stage, doing)
    if not explains_little(search.best, search.nominal):
        sharpened(search)
        without_weakest(search)
    search = with_backlash_tried(evidence, search, horizon)
    on_stage(f"final fits: {_in_words(search.best)}")
    step = step_for(search, search.best, step)
    final = final_fits(evidence, search, horizon, step)
    if show_more(final.best, search.best, search.prepared.problem.dof):
        on_stage(f"other windows, since they show more: {_in_words(final.best)}")
        search = carried(search, most_informative(final.prepared, final.best))
        search, step = _explored(evidence, search, horizon, step)
        final = final_fits(evidence, search, horizon, step_for(search, search.best, step))
    noise = noisy_inputs(final)
    if noise != evidence.input_noise:  # seen in all windows alone
        on_stage(f"other weights, since controls are noisy: {_in_words(final.best)}")
        evidence = replace(evidence, input_noise=noise)
        search = carried_over(evidence, search, final.best, horizon, step)
        search, step = _explored(evidence, search, horizon, step)
        final = final_fits(evidence, search, horizon, step_for(search, search.best, step))
    compare(final, search.best)
    final = at_a_part(final)
    prefer_static_friction(final)
    simulate_blocks(final)
    fits, problem = list(final.fits.values()), final.prepared.problem
    decision = decide(
        fits, final.nominal, final.prior, final.frame.Q, problem.dof,
        lambda one, two: same_but_late(one, two, problem),
    )  # fmt: skip
    return Located(decision, final.prepared, final, evidence)


def _searched(
    evidence: Evidence, on_stage: Callable[[str], None], doing: Callable[[str], None]
) -> tuple[Evidence, Search, int, float]:
    """Search in windows that grow; return their full length in instants and the time step.

    What is compared begins later where a late drive acts on what was sent before its log.
    """
    full = max(round(evidence.window / evidence.machine.sampling), LEAST)
    step = evidence.machine.model.opt.timestep
    horizon = limit_by_growth_rate(evidence, full, step)
    prepared, length = limit_by_residual(evidence, horizon, step)
    if length == horizon or meets_impacts(prepared.problem):
        prepared, step = short_enough(evidence, prepared, length, step)
    search = Search.on(prepared, list(evidence.candidates), evidence.most, None, doing)
    noise = noisy_inputs(search)
    if noise:
        evidence = replace(evidence, input_noise=noise)
        horizon = limit_by_input_noise(evidence, horizon, step)
        prepared, length = limit_by_residual(evidence, horizon, step)
        search = Search.on(prepared, list(evidence.candidates), evidence.most, None, doing)
    on_stage(f"windows of {length} instants: {search.nominal.rms:.2f} sigma with the nominal model")
    begun = from_bare_joints(evidence, search, length, horizon, step)
    if begun is not None:
        search, length = begun, horizon
        on_stage(f"windows of {length} instants at once: {_in_words(search.best)}")
    evidence, search, step = _explored_anew(evidence, search, length, step)
    while True:
        if length >= horizon:
            longer = _longer_if_stable(evidence, search, horizon, full, step)
            if longer <= horizon:
                return evidence, search, horizon, step
            horizon, step = longer, step / 2  # what a step does grows with a window
        step = step_for(search, search.best, step)
        search, length = _carried_to_longer(evidence, search, length, horizon, step)
        evidence, search, step = _explored_anew(evidence, search, length, step, rounds=3)
        on_stage(f"windows of {length} instants: {_in_words(search.best)}")


def _longer_if_stable(
    evidence: Evidence, search: Search, horizon: int, full: int, step: float
) -> int:
    """Lengthen the windows where what explains them is stabler than the nominal model.

    A wrist without damping and rotor falls within hundredths of a second, and so short windows
    hardly tell how it is damped; the one that was recorded does not fall.
    """
    if horizon == full or search.best.rms > ROUGH:
        return horizon
    longer = limit_by_growth_rate(evidence, full, step, search.best.hypothesis)
    return longer if longer > _LONGER * horizon else horizon


def _explored_anew(
    evidence: Evidence, search: Search, length: int, step: float, rounds: int = 5
) -> tuple[Evidence, Search, float]:
    """Explore, and once more without the first moments of each log where they alone do not fit."""
    found = unexplained_start(search)  # of sets from shorter windows
    if found is None:
        evidence, search = _weighted_anew(evidence, search, length, step)
        search, step = _explored(evidence, search, length, step, rounds)
        before, (evidence, search) = search, _weighted_anew(evidence, search, length, step)
        if search is not before:
            search, step = _explored(evidence, search, length, step, rounds)
        found = unexplained_start(search)
    if found is None:
        return evidence, search, step
    seconds, fit = found
    evidence = evidence.skipping_start(max(seconds, evidence.skipped_start))
    prepared = prepare(windows_of(evidence, length, step), fit.hypothesis)
    made = Search.on(prepared, search.candidates, search.most, fit.hypothesis, search.doing)
    made.fit(fit.members, fit.x, guess=fit.hypothesis)
    return evidence, *_explored(evidence, made, length, step, rounds)


def _weighted_anew(
    evidence: Evidence, search: Search, length: int, step: float
) -> tuple[Evidence, Search]:
    """Carry the best sets to weights that count with noise of the controls, or no longer do."""
    noise = noisy_inputs(search)
    if noise == evidence.input_noise:
        return evidence, search
    evidence = replace(evidence, input_noise=noise)
    return evidence, carried_over(evidence, search, search.best, length, step)


def _explored(
    evidence: Evidence, search: Search, length: int, step: float, rounds: int = 5
) -> tuple[Search, float]:
    """Explore, at a finer step where that tells more.

    At once where a set from shorter windows shows it, else once more.
    """
    finer = finer_step if search.best.members else straightened
    search, step = finer(evidence, search, search.best, length, step)
    leader = explore(search, rounds)
    made, step = finer_step(evidence, search, leader, length, step)
    if made is not search:
        explore(made, rounds)
    return made, step


def with_backlash_tried(evidence: Evidence, search: Search, length: int) -> Search:
    """Search on with a gap where that is what makes a motor late, at the step that it needs."""
    leader, machine = search.best, search.prepared.problem.machine
    joints = backlash_suspects(leader, machine)
    if machine.impacts or not joints:
        return search
    step = float(machine.model.opt.timestep) / GAP_DIVISION
    made = carried_over(evidence, search, leader, length, step)
    replace_by_backlash(made, made.best, joints)
    return search if made.best.names == leader.names else made


def _carried_to_longer(
    evidence: Evidence, search: Search, length: int, horizon: int, step: float
) -> tuple[Search, int]:
    """Carry the best sets to longer windows: at once to full ones where the leader holds there."""
    leader = search.best
    longer = next_length(length, horizon)
    for tried in dict.fromkeys((horizon, longer) if clean(leader) else (longer,)):
        made = carried_over(evidence, search, leader, tried, step)
        if made.best.rms < ROUGH:
            break
    return made, tried


def _in_words(fit: Fit) -> str:
    sites: dict[str, list[str]] = {}
    for c in fit.members:
        sites.setdefault(c.effect.id, []).append(c.site.name)
    names = [f"{effect} at {', '.join(at)}" for effect, at in sites.items()]
    return f"{'; '.join(names) or 'nothing missing'} ({fit.rms:.3f} sigma)"
