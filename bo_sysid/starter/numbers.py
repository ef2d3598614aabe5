"""How the numbers in names of a model go with those in names of a log."""

from collections.abc import Collection, Mapping, Sequence

from bo_sysid.starter.naming import Column, words

UNKNOWN = "?"
"""Stands for a number that says nothing of the log, in which no column has such a word."""
_Numbers = tuple[int, ...]


def as_counted(
    names: Sequence[str], columns: Sequence[Column]
) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return, by name and column, the words of the name with its numbers as that column counts.

    Names that differ by numbers alone are a family, in the model as in the log. Two families mean
    the same by a number where one has all numbers of the other, and both count from 0 or neither.
    Where one alone counts from 0 and both are as many, they go together in order: joint1 to joint7
    are q.0 to q.6. The numbers of all others say nothing.
    """
    out: dict[tuple[str, str], tuple[str, ...]] = {}
    for own in _families({n: words(n) for n in names}):
        for column_numbers in _families({c.name: c.words for c in columns}):
            meant = _meant(own.values(), column_numbers.values()) or _meant(
                own.values(), _differing(column_numbers.values())
            )
            for name, numbers in own.items():
                seen = _renumbered(words(name), meant.get(numbers))
                out |= {(name, column): seen for column in column_numbers}
    return out


def numbered(columns: Sequence[Column], count: int) -> list[Column]:
    """Return `count` columns whose names differ by a number alone, in its order; else nothing."""
    families = _families({c.name: c.words for c in columns})
    fits = next((f for f in families if len(f) == count), {})
    return by_number([c for c in columns if c.name in fits])


def by_number(columns: Sequence[Column]) -> list[Column]:
    """Return the columns in the order of their numbers."""
    return sorted(columns, key=lambda c: _numbers(c.words) or (0,))


def _families(named: Mapping[str, tuple[str, ...]]) -> list[dict[str, _Numbers]]:
    """Return the names that differ by numbers alone together, each with its numbers."""
    families: dict[tuple[str, ...], dict[str, _Numbers]] = {}
    for name, parts in named.items():
        stem = tuple(w for w in parts if not w.isdigit())
        families.setdefault(stem, {})[name] = _numbers(parts)
    return list(families.values())


def _numbers(parts: Sequence[str]) -> _Numbers:
    return tuple(int(w) for w in parts if w.isdigit())


def _differing(column_numbers: Collection[_Numbers]) -> list[_Numbers]:
    """Return numbers without those that all have, as a robot's in robot1_joint3."""
    kept = [k for k, own in enumerate(zip(*column_numbers, strict=False)) if len(set(own)) > 1]
    return [tuple(n[k] for k in kept) for n in column_numbers]


def _meant(
    own: Collection[_Numbers], column_numbers: Collection[_Numbers]
) -> dict[_Numbers, _Numbers]:
    """Return what each number of a family is called in another; empty where that is open."""
    one, other = sorted(set(own)), sorted(set(column_numbers))
    from_0 = [any(n[-1:] == (0,) for n in numbers) for numbers in (one, other)]
    if from_0[0] == from_0[1]:
        within = set(one) <= set(other) or set(other) <= set(one)
        return {n: n for n in one} if within else {}
    pairs = list(zip(one, other, strict=False))
    steps = {tuple(y - x for x, y in zip(*pair, strict=False)) for pair in pairs}
    return dict(pairs) if len(one) == len(other) > 1 and len(steps) == 1 else {}


def _renumbered(parts: Sequence[str], numbers: _Numbers | None) -> tuple[str, ...]:
    """Return the words of a name with other numbers, or with none that is known."""
    left = iter(map(str, numbers or ()))
    return tuple(next(left, UNKNOWN) if w.isdigit() else w for w in parts)
