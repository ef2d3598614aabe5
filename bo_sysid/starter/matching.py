"""Which column belongs to which joint and actuator, with reason and confidence."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from bo_sysid.recording import RawTable
from bo_sysid.starter.columns import WORDS, Column, derivatives, words

_SURE, _LIKELY, _ORDER = 0.9, 0.6, 0.3
_PARTS = frozenset(
    {"joint", "motor", "link", "actuator", "servo", "axis", "drive", "hinge", "slide"}
)
_GENERIC = frozenset().union(*WORDS.values())
_LETTER, _BEGUN, _FRAGMENT = 0.8, 0.75, 4  # a letter; a word's beginning, and its least length


Fits = Callable[[str, Column], bool]


@dataclass(frozen=True)
class Guess:
    """A channel, and the column that it is thought to be.

    Attributes:
        channel: of the model.
        column: of the log.
        unit: what the name or the file says about it.
        reason: why.
        confidence: 0 to 1.
    """

    channel: str
    column: str
    unit: str
    reason: str
    confidence: float


def match(
    kind: str,
    elements: Sequence[str],
    columns: Sequence[Column],
    also: Sequence[str] = (),
    *,
    trust: float = 1.0,
    fits: Fits = lambda element, column: True,
) -> list[Guess]:
    """Match elements of a model with columns of one kind.

    Args:
        kind: of the channels: qpos, qvel, ctrl or goal.
        elements: names of joints or actuators.
        columns: candidates.
        also: for each element another name that a column may carry, as the joint of an actuator.
        trust: what that other name counts, of the element's own.
        fits: whether a column can belong to an element, as its unit says.
    """
    if not elements or not columns:
        return []
    counted = _counted_alike(elements, columns)
    score = np.array(
        [
            [
                fits(n, c) * max(_likeness(n, c, counted), trust * _likeness(o, c, counted))
                for c in columns
            ]
            for n, o in zip(elements, also or elements, strict=True)
        ]
    )
    guesses = []
    rows, picked = linear_sum_assignment(-score)
    for r, p in zip(rows.tolist(), picked.tolist(), strict=True):
        if score[r, p] >= _LIKELY:
            sure = score[r, p] >= _SURE
            reason = "the name" if sure else "a similar name"
            guesses.append(_guess(kind, elements[r], columns[p], reason, float(score[r, p])))
    guesses += _alone(kind, elements, columns, guesses, fits)
    used = {g.column for g in guesses}
    unused = [c for c in columns if c.name not in used]
    left = [e for e in elements if f"{kind}.{e}" not in {g.channel for g in guesses}]
    family = _family(unused, len(left))
    if family and all(fits(e, c) for e, c in zip(left, family, strict=True)):
        reason = "the order alone" if len(left) > 1 else "nothing else is left"
        confidence = _ORDER if len(left) > 1 else 0.5
        return guesses + [
            _guess(kind, e, c, reason, confidence) for e, c in zip(left, family, strict=True)
        ]
    return guesses + _in_order(kind, elements, columns, guesses, fits)


def _alone(
    kind: str,
    elements: Sequence[str],
    columns: Sequence[Column],
    known: Sequence[Guess],
    fits: Fits,
) -> list[Guess]:
    """Match what is left and alone has a unit that fits."""
    used, told = {g.column for g in known}, {g.channel for g in known}
    left = [e for e in elements if f"{kind}.{e}" not in told]
    unused = [c for c in columns if c.name not in used]
    found = []
    for e in left:
        fit = [c for c in unused if fits(e, c)]
        if len(fit) == 1 and len(unused) > 1 and sum(fits(o, fit[0]) for o in left) == 1:
            found.append(_guess(kind, e, fit[0], "no other unit fits", 0.5))
    return found


def _in_order(
    kind: str,
    elements: Sequence[str],
    columns: Sequence[Column],
    known: Sequence[Guess],
    fits: Fits,
) -> list[Guess]:
    """Match what lies between two matches, or beyond the last, in the log as in the model."""
    place = {c.name: i for i, c in enumerate(columns)}
    at = [(elements.index(g.channel.split(".", 1)[1]), place[g.column]) for g in known]
    at = [(-1, -1), *sorted(at), (len(elements), len(columns))]
    if not known or any(b[1] <= a[1] for a, b in pairwise(at)):
        return []  # another order
    found = []
    for (first, before), (last, after) in pairwise(at):
        between, told = elements[first + 1 : last], columns[before + 1 : after]
        if len(between) == len(told):
            reason = "the order: the columns beside it are known"
            found += [
                _guess(kind, e, c, reason, _ORDER)
                for e, c in zip(between, told, strict=True)
                if fits(e, c)
            ]
    return found


def named_after(elements: Sequence[str], column: Column) -> bool:
    """Whether a column of no other kind is called like an element, and nothing more."""
    return column.kind == "other" and set(column.words) in [set(words(e)) for e in elements]


def rates_of(table: RawTable, positions: Sequence[Guess], columns: Sequence[Column]) -> list[Guess]:
    """Match velocities with the positions that they are the rates of."""
    velocities = [c for c in columns if c.kind == "velocity"]
    found = derivatives(table, [*(g.column for g in positions), *(c.name for c in velocities)])
    out = []
    for g in positions:
        for c in velocities:
            if found.get(c.name) == g.column:
                channel = g.channel.replace("qpos.", "qvel.", 1)
                out.append(Guess(channel, c.name, c.unit, f"it is the rate of {g.column}", 0.9))
    return out


def _guess(kind: str, element: str, column: Column, reason: str, confidence: float) -> Guess:
    return Guess(f"{kind}.{element}", column.name, column.unit, reason, confidence)


def _counted_alike(elements: Sequence[str], columns: Sequence[Column]) -> bool:
    """Whether every numbered element has its number among as many numbered columns, or more.

    A model that counts from 0 and a log that counts from 1 share most of their numbers, and none
    of them means the same.
    """
    told = max(_families(columns), key=len, default=[])
    own = [tuple(int(w) for w in words(e) if w.isdigit()) for e in elements]
    if len(told) < len(elements) or not all(own):
        return True
    return set(own) <= {tuple(_number(c)) for c in told}


def _likeness(element: str, column: Column, counted: bool = True) -> float:
    """Return how much of an element's name a column carries, 0 to 1.

    Args:
        element: its name.
        column: any.
        counted: whether a number that both have, and nothing else, says anything.
    """
    if column.name.endswith((f".{element}", f"/{element}")) or column.name == element:
        return 1.0
    own = words(element)
    bare = [w for w in own if w not in _PARTS]
    special = [w for w in bare if w not in _GENERIC] or bare or list(own)
    shared = [w for w in special if w in column.words]
    if shared and len(shared) == len(special):
        letters = [w for w in shared if not w.isdigit()]
        named = 0.95 if any(len(w) > 1 for w in letters) else _LETTER
        return named if letters else 0.6 * counted
    if (
        special
        and (counted or not all(w.isdigit() for w in special))
        and all(_begun(w, column.words) for w in special)
    ):
        return _BEGUN
    return 0.5 * len(shared) / max(len(special), 1)


def _begun(word: str, others: Sequence[str]) -> bool:
    """Whether a word is one of some others, or begins like one, as pend and pendulum do."""
    return any(
        w == word
        or (min(len(w), len(word)) >= _FRAGMENT and (w.startswith(word) or word.startswith(w)))
        for w in others
    )


def numbered(columns: Sequence[Column], count: int) -> list[Column]:
    """Return `count` columns whose names differ by a number alone, in its order; else nothing."""
    fits = next((f for f in _families(columns) if len(f) == count), [])
    return sorted(fits, key=_number)


def _families(columns: Sequence[Column]) -> list[list[Column]]:
    """Return the columns whose names differ by a number alone, together."""
    families: dict[tuple[str, ...], list[Column]] = {}
    for c in columns:
        stem = tuple(w for w in c.words if not w.isdigit())
        families.setdefault(stem, []).append(c)
    return list(families.values())


def _family(columns: Sequence[Column], count: int) -> list[Column]:
    """Return `count` numbered columns, or all columns where there are as many; else nothing."""
    found = numbered(columns, count)
    if found or len(columns) != count:
        return found
    return sorted(columns, key=_number)


def _number(column: Column) -> list[int]:
    return [int(w) for w in column.words if w.isdigit()] or [0]
