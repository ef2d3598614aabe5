"""What may stand in the place of a name, for all that the recordings tell."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

Key = tuple[str, str]
"""Effect and site."""
Entry = Mapping[str, Any]
"""A name as `diagnosis.json` has it: effect, kind, site, value."""


def irreducible(found: frozenset[Key], others: Sequence[frozenset[Key]]) -> list[frozenset[Key]]:
    """Return the sets that others do not make up together.

    Where {a, B} and {A, b} are as good as what was found, {A, B}, the set {a, b} says nothing more.

    Args:
        found: effects and sites that were found.
        others: sets that the recordings do not tell from them.
    """
    instead: dict[Key, list[frozenset[Key]]] = {}
    for other in others:
        if len(found - other) == 1:
            (gone,) = found - other
            instead.setdefault(gone, []).append(other - found)

    def made_up(other: frozenset[Key]) -> bool:
        gone = found - other
        ways = product(*(instead.get(key, ()) for key in gone))
        return len(gone) > 1 and any(frozenset().union(*way) == other - found for way in ways)

    return [other for other in others if not made_up(other)]


def exchanges(
    found: frozenset[Key], others: Mapping[frozenset[Key], Sequence[Entry]], most: int
) -> dict[Key, tuple[tuple[Entry, ...], ...]]:
    """Return for each name that was found the sets that may stand in its place.

    A set that leaves all others as they are is told without them; any other set is told whole, at
    each of the names that it lacks.

    Args:
        found: effects and sites that were found.
        others: sets that the recordings do not tell from them, by their names.
        most: sets that are told of one name.
    """
    alternatives: dict[Key, list[tuple[Entry, ...]]] = {key: [] for key in found}
    for other in irreducible(found, list(others)):
        gone, whole = found - other, tuple(others[other])
        own = tuple(e for e in whole if (e["effect"], e["site"]) not in found)
        for key in gone:
            alternatives[key].append(own if own and len(gone) == 1 else whole)
    return {key: tuple(sets[:most]) for key, sets in alternatives.items()}
