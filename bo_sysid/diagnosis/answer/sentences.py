"""A diagnosis in sentences, to be read aloud."""

from collections.abc import Mapping, Sequence

import pandas as pd

from bo_sysid.diagnosis.answer.argmin import ArgminSets
from bo_sysid.diagnosis.answer.exchanges import irreducible
from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.wording import plural, spoken
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import units_beyond, units_of
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.effects import Machine
from bo_sysid.effects.units import unit_at
from bo_sysid.intervals import Quantity, amount

_RIVALS = 3
_LISTED = 8  # parameters
_LACKS = "that the model lacks"  # in a sentence about what is not there at all
_FAVOURED = (
    "the recordings are for the former, but by differences so small that slight errors of the "
    "model make them as well"
)
_UNUSUAL = "these recordings do not tell, and the former is the simpler or more usual explanation"
_UNTOLD = "these recordings do not tell"
_CLEARLY = 6.0  # difference of cross-validated squares, a likelihood of one in twenty
_FAR_LESS = 0.05  # times the probability of the answer
_DIFFERS = 0.2  # of a magnitude, from which a difference between recordings is worth telling
_SHOWN = 4  # recordings
_MANY = 3  # members of a group from which on one sentence says them all


def found_sentences(findings: Sequence[Finding]) -> list[str]:
    """Return the findings in words: one sentence each, one for all of a group of three or more."""
    groups: dict[str, list[Finding]] = {}
    for f in findings:
        groups.setdefault(f.group or f"{f.effect} at {f.kind} {f.site}", []).append(f)
    sentences: list[str] = []
    for name, members in groups.items():
        if members[0].group is None or len(members) < _MANY:
            sentences += [f.sentence for f in members]
        else:
            sentences.append(_group_sentence(name, members))
    return sentences


def noise_sentence(noise: Mapping[str, float]) -> str:
    """Return what noise of recorded controls was counted with, in words; empty where none was.

    Args:
        noise: σ by actuator, in the unit of its control.
    """
    if not noise:
        return ""
    each = ", ".join(f"{sigma:.2g} for {actuator}" for actuator, sigma in noise.items())
    return (
        f"The recorded controls hold noise that did not move the machine ({each}, in their own "
        "units): what it does is counted as noise, and is in the noise floor."
    )


def _group_sentence(name: str, members: Sequence[Finding]) -> str:
    """Return "Dry friction on 3 joints, which the model lacks: base 4.01 ± 0.04 N m, …"."""
    each = ", ".join(f"{f.site.replace('_', ' ')} {amount(f.quantity)}" for f in members)
    lacks = name.startswith(("a ", "an ")) or all(_LACKS in f.sentence for f in members)
    beside = ", which the model lacks" if lacks else " differs from the model's by"
    return f"{name[0].upper()}{name[1:]}{beside}: {each}."


def parameters_sentence(parameters: pd.DataFrame) -> str:
    """Return what the study's parameters were fitted to, in words; empty where it has none.

    Args:
        parameters: see `Frozen.parameters`.
    """
    if parameters.empty:
        return ""
    changed = []
    for p in parameters.head(_LISTED).to_dict("records"):
        bound = ", at its bound" if p["at_bound"] else ""
        unit = "–" if p["unit"] in ("", "1") else p["unit"]
        fitted = amount(Quantity(p["fitted"], unit, (p["low95"], p["high95"])))
        changed.append(f"{p['name']} {fitted} ({p['model']:.4g}{bound})")
    more = f" and {len(parameters) - _LISTED} more" if len(parameters) > _LISTED else ""
    return f"Fitted, and in the model as it was: {'; '.join(changed)}{more}."


def stood_in_sentence(parameters: Sequence[Candidate], fit: Fit) -> str:
    """Return which of the study's parameters a fit does without, in words; empty if none."""
    out = [p.site.name for p in parameters if p not in fit.hypothesis.nuisances]
    if not out:
        return ""
    verb = "was" if len(out) == 1 else "were"
    return f"{', '.join(out)} {verb} not fitted: the friction that was found stands there instead."


def shift_sentence(shifts: Mapping[str, float]) -> str:
    """Return that commands are taken later than stamped, in words; empty where none are.

    Args:
        shifts: of the study's clocks of commands in [s], by channel or kind of channel.
    """
    late = {n: s for n, s in shifts.items() if s > 0}
    if not late:
        return ""
    each = ", ".join(f"{n} by {1e3 * s:.3g} ms" for n, s in late.items())
    return (
        f"The study takes commands later than stamped ({each}). If that is the machine and not the "
        "clock of the log, the repaired model lacks this delay, beyond any named here: remove "
        "`shift` under recordings.clocks, and it is looked for as a delay of the actuators."
    )


def disputed_sentence(disputed: Sequence[Candidate]) -> str:
    """Return what recordings disagree on, in words; empty where they do not."""
    if not disputed:
        return ""
    each = [_at_site(c) for c in disputed]
    return (
        f"The recordings do not agree on {', nor on '.join(each)}: no finding is made of what "
        "differs so much between them."
    )


def disagreements(members: Sequence[Candidate], by_recording: pd.DataFrame) -> list[str]:
    """Return in words on which magnitudes of an answer its recordings do not agree.

    They do not where intervals of two recordings lie apart, by more than a trifle.

    Args:
        members: of the answer.
        by_recording: columns recording, effect, site, value, low, high and unit.
    """
    found = []
    for c in members:
        own = (by_recording.effect == c.effect.id) & (by_recording.site == c.site.name)
        rows = by_recording[own]
        if rows.empty or rows.low.max() <= rows.high.min():
            continue
        apart = rows.value.max() - rows.value.min()
        if apart > _DIFFERS * rows.value.abs().mean():
            each = [f"{r.value:.3g} in {r.recording}" for r in rows.itertuples()]
            values = ", ".join([*each[: _SHOWN - 1], each[-1]] if len(each) > _SHOWN else each)
            found.append(
                f"The recordings do not agree on {_at_site(c)}: {values} ({rows.unit.iloc[0]})."
            )
    return found


def _at_site(c: Candidate) -> str:
    return c.effect.noun + ("" if c.site.kind == "world" else f" at {spoken(c.site)}")


def rivals(decision: Decision, machine: Machine) -> list[str]:
    """Return a sentence about what may be in the place of what is answered, if anything may."""
    best, rivals_of = decision.best, dict[tuple[str, str], list[str]]()
    by_keys = {frozenset(c.key for c in f.members): f for f in decision.equivalents}
    sets = irreducible(frozenset(c.key for c in best.members), list(by_keys))
    for f in [by_keys[s] for s in sets][:_RIVALS]:
        theirs, ours = _beyond(f, best, machine), _beyond(best, f, machine, sized=False)
        if theirs and ours:
            rivals_of.setdefault((ours, _why_not(decision, f)), []).append(theirs)
    return [
        f"Instead of {ours} it may be {', or '.join(theirs)}: {why_not}."
        for (ours, why_not), theirs in rivals_of.items()
    ]


def _why_not(decision: Decision, other: Fit) -> str:
    """Return in words what speaks for the answer beside a set of nearly the same predictions."""
    if float((other.cv - decision.best.cv).sum()) > _CLEARLY:
        return _FAVOURED
    known = zip(decision.fits, decision.probability, strict=True)
    probability = {f.key: float(p) for f, p in known}
    best = probability.get(decision.best.key, 0.0)
    return _UNUSUAL if probability.get(other.key, 0.0) < _FAR_LESS * best else _UNTOLD


def _beyond(fit: Fit, other: Fit, machine: Machine, *, sized: bool = True) -> str:
    """Return in words what a set names and another does not."""
    words = []
    for unit in units_beyond(fit, other):
        held = [(fit.members[k], fit.members[k].full(fit.x[k])) for k in unit]
        by_unit: dict[str, list[float]] = {}  # hinges and slides have their own
        for c, x in held:
            value = float(c.effect.reported(x, machine, c.site))
            by_unit.setdefault(_unit(c, machine), []).append(value)
        size = ", ".join(f"{_range(values)}{unit}" for unit, values in by_unit.items())
        # of several numbers the first alone does not say how large it is
        one = all(min(c.size, c.effect.acting) == 1 or c.effect.vector for c, _ in held)
        size_text = f" ({size})" if sized and one else ""
        words.append(unit_words([c for c, _ in held]) + size_text)
    return " with ".join(words)


def _range(values: Sequence[float]) -> str:
    return " to ".join(dict.fromkeys(f"{v:.3g}" for v in (min(values), max(values))))


def unit_words(members: Sequence[Candidate]) -> str:
    """Return what one effect is and where: at its site, or at how many where it is a group."""
    first = members[0]
    if len(members) == 1:
        return _at_site(first)
    return f"{first.effect.noun} at {len(members)} {plural(first.site.kind)}"


def _unit(c: Candidate, machine: Machine) -> str:
    unit = unit_at(c.effect.unit, c.site, machine)
    return "" if unit in ("", "1", "–", "relative") else f" {unit}"


def doubts(decision: Decision, searched: ArgminSets) -> list[str]:
    """Return a sentence where the search of the arg-min and the posterior disagree."""
    if not searched.disagrees(decision.best):
        return []
    other = searched.best
    return [
        f"Which set it is, is open: over bootstraps of the recordings the least deviation lies in "
        f"{set_words(other)} ({searched.of(other):.2f}) more often than in "
        f"{set_words(decision.best)} ({searched.of(decision.best) or 0.0:.2f})."
    ]


def set_words(fit: Fit) -> str:
    """Return a set in words: "dry friction at 6 joints + payload at the forearm"."""
    if not fit.members:
        return "nothing is missing"
    units = ([fit.members[k] for k in unit] for unit in units_of(fit))
    return " + ".join(unit_words(members) for members in units)
