"""Which column belongs to which joint and actuator, with reason and confidence."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from bo_sysid.recording import RawTable
from bo_sysid.starter.columns import derivatives
from bo_sysid.starter.naming import WORDS, Column, words
from bo_sysid.starter.numbers import UNKNOWN, as_counted, by_number, numbered

_SURE, _LIKELY, _OPEN, _ORDER = 0.9, 0.6, 0.5, 0.3
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
    guesses = _named(kind, elements, columns, also or elements, trust, fits)
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


def _named(
    kind: str,
    elements: Sequence[str],
    columns: Sequence[Column],
    also: Sequence[str],
    trust: float,
    fits: Fits,
) -> list[Guess]:
    """Match by names, of the elements or those beside them."""
    own, own_also = as_counted(elements, columns), as_counted(also, columns)
    common = _of_all(elements), _of_all(also)
    likeness = [
        [
            max(
                _likeness(n, c, own[n, c.name], common[0]),
                _likeness(o, c, own_also[o, c.name], common[1], trust),
            )
            for c in columns
        ]
        for n, o in zip(elements, also, strict=True)
    ]
    score = np.array(
        [
            [fits(n, c) * like for c, (like, _) in zip(columns, row, strict=True)]
            for n, row in zip(elements, likeness, strict=True)
        ]
    )
    rows, picked = linear_sum_assignment(-score)
    pairs = zip(rows.tolist(), picked.tolist(), strict=True)
    chosen = {p: r for r, p in pairs if score[r, p] >= _LIKELY}
    found = []
    for p, r in chosen.items():
        like, reason = likeness[r][p]
        spare = [k for k in range(len(columns)) if k not in chosen and score[r, k] >= score[r, p]]
        if rivals := [
            columns[k].name for k in spare if _differ_by_element_alone(columns[k], columns[p])
        ]:
            like, reason = min(like, _OPEN), f"{reason}, which {rivals[0]} has as well"
        found.append(_guess(kind, elements[r], columns[p], reason, like))
    return found


def _differ_by_element_alone(one: Column, other: Column) -> bool:
    """Whether two columns say the same beside the names of elements, as left_pos and right_pos."""
    return _GENERIC & set(one.words) == _GENERIC & set(other.words)


def _alone(
    kind: str,
    elements: Sequence[str],
    columns: Sequence[Column],
    known: Sequence[Guess],
    fits: Fits,
) -> list[Guess]:
    """Match what is left and alone has a unit that fits."""
    used, channels = {g.column for g in known}, {g.channel for g in known}
    left = [e for e in elements if f"{kind}.{e}" not in channels]
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
        between_elements, between_columns = elements[first + 1 : last], columns[before + 1 : after]
        if len(between_elements) == len(between_columns):
            reason = "the order: the columns beside it are known"
            found += [
                _guess(kind, e, c, reason, _ORDER)
                for e, c in zip(between_elements, between_columns, strict=True)
                if fits(e, c)
            ]
    return found


def rates_of(table: RawTable, positions: Sequence[Guess], columns: Sequence[Column]) -> list[Guess]:
    """Match velocities with the positions that they are the rates of, and are no surer than."""
    velocities = [c for c in columns if c.kind == "velocity"]
    names = [c.name for c in velocities]
    found = derivatives(table, [*(g.column for g in positions), *names], names)
    out = []
    for g in positions:
        for c in velocities:
            if found.get(c.name) == g.column:
                channel = g.channel.replace("qpos.", "qvel.", 1)
                sure = min(_SURE, g.confidence)
                out.append(Guess(channel, c.name, c.unit, f"it is the rate of {g.column}", sure))
    return out


def _guess(kind: str, element: str, column: Column, reason: str, confidence: float) -> Guess:
    return Guess(f"{kind}.{element}", column.name, column.unit, reason, confidence)


def _likeness(
    element: str,
    column: Column,
    seen: Sequence[str],
    of_all: Collection[str],
    trust: float = 1.0,
) -> tuple[float, str]:
    """Return how much of an element's name a column carries, 0 to 1, and what that is called.

    Args:
        element: its name.
        column: any.
        seen: the words of the name, numbered as the column counts.
        of_all: words that all elements' names have.
        trust: what the name counts.
    """
    recounted = tuple(seen) != words(element) and UNKNOWN not in seen
    if recounted:
        return trust * min(_shared(seen, column, of_all), _LIKELY), (
            "a similar name; the log counts from another number"
        )
    exact = column.name.endswith((f".{element}", f"/{element}")) or column.name == element
    likeness = trust * (1.0 if exact else _shared(seen, column, of_all))
    return likeness, "the name" if likeness >= _SURE else "a similar name"


def _of_all(names: Sequence[str]) -> frozenset[str]:
    """Return the words that all names have, as wheel in left_wheel and right_wheel."""
    return frozenset.intersection(*(frozenset(words(n)) for n in names))


def _shared(own: Sequence[str], column: Column, of_all: Collection[str]) -> float:
    """Return how much of the words of a name a column carries, 0 to 1."""
    bare = [w for w in own if w not in _PARTS]
    special = [w for w in bare if w not in _GENERIC] or bare or list(own)
    if not special:  # a name of marks alone is like no other
        return 0.0
    shared = [w for w in special if w in column.words]
    if shared and len(shared) == len(special):
        letters = [w for w in shared if not w.isdigit()]
        named = 0.95 if any(len(w) > 1 for w in letters) else _LETTER
        return named if letters else _LIKELY
    distinctive = [w for w in special if w not in of_all and not w.isdigit()]
    if all(_begun(w, column.words) for w in distinctive or special):
        return _BEGUN
    return 0.5 * len(shared) / max(len(special), 1)


def _begun(word: str, others: Sequence[str]) -> bool:
    """Whether a word is one of some others, or begins like one, as pend and pendulum do."""
    return any(
        w == word
        or (min(len(w), len(word)) >= _FRAGMENT and (w.startswith(word) or word.startswith(w)))
        for w in others
    )


def _family(columns: Sequence[Column], count: int) -> list[Column]:
    """Return `count` numbered columns, or all columns where there are as many; else nothing."""
    found = numbered(columns, count)
    if found or len(columns) != count:
        return found
    return by_number(columns)
