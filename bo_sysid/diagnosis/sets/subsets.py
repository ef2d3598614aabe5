"""Score sets of effects by linear algebra on the Gram matrix of their signatures.

Greedy selection names dry friction and payload as armature and spring; therefore all pairs and
triples of the promising candidates are scored, without any simulation, and so are groups ("dry
friction on all joints, each its own") and sets of groups.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.diagnosis.windows.candidate import Candidate

PAIRED, TRIPLED = 170, 60  # how many units are combined in twos and in threes
_BESIDE_GROUPS = 20  # single candidates tried beside two groups
_PER_SITE = 3  # variants of one effect at one site that are combined
_DEAD = 1e-3  # of a column's square that projection must leave
_SILENT = 3.0  # [sigma, over all observations] that a candidate must be able to move
_RIDGE, _TINY = 1e-7, 1e-12
_BEYOND = 1.5  # of a bound, up to which a linear estimate may lie
_TOGETHER = 256  # sets solved at once, times their width


@dataclass(frozen=True)
class Unit:
    """What counts as one effect: a candidate, or a group of them.

    Attributes:
        members: numbers of the candidates.
        group: id of the effect that all sites of a group have in common, None for one candidate.
    """

    members: tuple[int, ...]
    group: str | None = None


@dataclass(frozen=True)
class Scored:
    """A set of units with its linear fit.

    Attributes:
        gain: how much of the squared residual it explains.
        units: the set.
        x: magnitudes of all members, one after the other.
    """

    gain: float
    units: tuple[Unit, ...]
    x: Float[np.ndarray, " m"]

    @property
    def members(self) -> tuple[int, ...]:
        """Numbers of the candidates in the set."""
        return tuple(i for u in self.units for i in u.members)


@dataclass(frozen=True)
class Gram:
    """Inner products of the signatures of candidates, nuisances eliminated, unit diagonal.

    Attributes:
        candidates: the candidates.
        G: `p x p` normalised.
        b: `p` inner products with the residual, normalised.
        scale: `p` norms.
        low: `p` lower bounds of the normalised magnitudes.
        high: `p` upper bounds.
        alive: `p` whether a column says anything.
        columns: columns of each candidate.
    """

    candidates: tuple[Candidate, ...]
    G: Float[np.ndarray, "p p"]
    b: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    alive: Bool[np.ndarray, " p"]
    columns: tuple[Int[np.ndarray, " _"], ...]

    def living(self) -> list[int]:
        """Return the candidates with a column that says something."""
        return [i for i, c in enumerate(self.columns) if self.alive[c].any()]

    def inside(
        self, x: Float[np.ndarray, "*s p"], index: Int[np.ndarray, "*s p"]
    ) -> Bool[np.ndarray, "*s p"]:
        """Return which linear estimates lie within their bounds, or not far beyond."""
        low, high = self.low[index], self.high[index]
        low, high = np.minimum(low, _BEYOND * low), np.maximum(high, _BEYOND * high)
        return np.asarray((x >= low) & (x <= high))

    def score(self, sets: Sequence[tuple[Unit, ...]]) -> list[Scored]:
        """Return the sets whose linear fit is within bounds."""
        out: list[Scored] = []
        widths = np.array([sum(len(self.columns[i]) for u in s for i in u.members) for s in sets])
        for width in np.unique(widths):
            same = [sets[int(k)] for k in np.flatnonzero(widths == width)]
            step = max(_TOGETHER * 64 // max(int(width) ** 2, 1), 16)
            for k in range(0, len(same), step):
                out += self._solved(same[k : k + step])
        return out

    def _solved(self, sets: Sequence[tuple[Unit, ...]]) -> list[Scored]:
        index = np.array(
            [np.concatenate([self.columns[i] for u in s for i in u.members]) for s in sets]
        )
        G = self.G[index[:, :, None], index[:, None, :]]
        x = np.linalg.solve(G, self.b[index][..., None])[..., 0]
        inside = self.inside(x, index)
        gain = (x * self.b[index]).sum(axis=1)
        return [
            Scored(float(gain[k]), tuple(sets[int(k)]), x[k] / self.scale[index[k]])
            for k in np.flatnonzero(inside.all(axis=1))
        ]


def gram(
    candidates: Sequence[Candidate],
    G: Float[np.ndarray, "a a"],
    b: Float[np.ndarray, " a"],
    owner: Int[np.ndarray, " a"],
    now: dict[int, Float[np.ndarray, " _"]],
    fixed: Sequence[int] = (),
) -> Gram:
    """Eliminate the nuisances and normalise.

    Args:
        candidates: the candidates.
        G: inner products of all columns.
        b: inner products with the residual.
        owner: candidate of each column; -1 for a nuisance.
        now: present magnitudes of candidates that the residual already contains.
        fixed: candidates whose magnitudes adapt as nuisances do.
    """
    out = (owner < 0) | np.isin(owner, fixed)
    rest = ~out
    norm = np.diag(G)[rest]
    if out.any():
        unit = np.sqrt(np.maximum(np.diag(G)[out], _TINY))[:, None]  # parameters have any unit
        N = G[np.ix_(out, out)] / unit / unit.T + 1e-9 * np.eye(len(unit))
        K = np.linalg.solve(N, np.column_stack([G[np.ix_(out, rest)], b[out]]) / unit) / unit
        b = b[rest] - G[np.ix_(rest, out)] @ K[:, -1]
        G = G[np.ix_(rest, rest)] - G[np.ix_(rest, out)] @ K[:, :-1]
    else:
        G, b = G[np.ix_(rest, rest)], b[rest]
    owner = owner[rest]
    columns = tuple(np.flatnonzero(owner == i) for i in range(len(candidates)))
    zero = [now.get(i, np.zeros(c.size)) for i, c in enumerate(candidates) if len(columns[i])]
    held = [c for i, c in enumerate(candidates) if len(columns[i])]
    low = np.concatenate([c.low - z for c, z in zip(held, zero, strict=True)] or [np.zeros(0)])
    high = np.concatenate([c.high - z for c, z in zip(held, zero, strict=True)] or [np.zeros(0)])
    scale = np.sqrt(np.maximum(np.diag(G), 1e-30))
    alive = (np.diag(G) >= _DEAD * norm) & (
        scale * np.maximum(np.abs(low), np.abs(high)) >= _SILENT
    )
    G = G / scale[:, None] / scale * np.outer(alive, alive)
    G[~alive, ~alive] = 1.0
    return Gram(
        tuple(candidates), G + _RIDGE * np.eye(len(G)), b / scale * alive, scale, low * scale,
        high * scale, alive, columns,
    )  # fmt: skip


def groups(candidates: Sequence[Candidate]) -> tuple[Unit, ...]:
    """Return the effects that can be missing at all sites at once, as units."""
    by_effect: dict[str, dict[str, int]] = {}
    for i, c in enumerate(candidates):
        if c.effect.grouped and not c.secant:
            by_effect.setdefault(c.effect.id, {}).setdefault(c.site.name, i)
    return tuple(Unit(tuple(m.values()), e) for e, m in by_effect.items() if len(m) > 1)


def search(
    table: Gram,
    most: int,
    grouped: Sequence[Unit] = (),
    *,
    deepest: int = 3,
    paired: int = PAIRED,
) -> dict[int, list[Scored]]:
    """Score singles, then sets of two and three of the promising ones, best first.

    Args:
        table: the inner products.
        most: how many effects a set may count as.
        grouped: groups to consider beside the single candidates.
        deepest: most units in a set.
        paired: how many candidates are combined in twos.

    Returns:
        The scored sets by size.
    """
    living = [i for i in table.living() if table.candidates[i].effect.weight <= most]
    singles = table.score([(Unit((i,)),) for i in living])
    whole = [_within_bounds(table, u) for u in grouped]
    some = table.score([(u,) for u in whole if u is not None])
    found = {1: _ranked(singles + some)}
    if min(most, deepest) < 2:
        return found
    units = _promising(table, found[1], living, paired) + [s.units[0] for s in some]
    found[2] = _ranked(table.score(_combined(table, units, 2, most)))
    if min(most, deepest) < 3:
        return found
    best: dict[Unit, float] = {}
    for s in found[2]:
        for u in s.units:
            best[u] = max(best.get(u, 0.0), s.gain)
    leaders = sorted(best, key=lambda u: -best[u])
    loners = [u for u in leaders if u.group is None][:TRIPLED]
    found[3] = _ranked(
        table.score(
            _combined(table, loners, 3, most)
            + _combined(table, [u for u in leaders if u.group is not None], 3, most)
            + _mixed(table, [u for u in leaders if u.group is not None], loners, most)
        )
    )
    return found


def clashes(candidates: Iterable[Candidate]) -> bool:
    """Whether a set names one effect twice at a site, or an effect beside one that contains it.

    Nor can two joints be added at one: the mass between them would be none.
    """
    held = list(candidates)
    keys = [k for c in held for k in c.exclusive_keys]
    if len(set(keys)) < len(keys):
        return True
    return any(c.effect.nested and (c.effect.nested, c.site.name) in keys for c in held)


def _promising(
    table: Gram, ranked: Sequence[Scored], living: Sequence[int], most: int
) -> list[Unit]:
    """Return the best single candidates, few variants of each, then the rest in their order."""
    seen: dict[tuple[str, str], int] = {}
    keep: list[int] = []
    for s in ranked:
        if s.units[0].group is None:
            (i,) = s.members
            key = table.candidates[i].key
            seen[key] = seen.get(key, 0) + 1
            if seen[key] <= _PER_SITE:
                keep.append(i)
    rest = [i for i in living if i not in keep and not _one_of_many(table.candidates[i])]
    return [Unit((i,)) for i in (keep + rest)[:most]]


def _one_of_many(c: Candidate) -> bool:
    """Whether there are others with other shapes; a place on a body is none."""
    return len(c.shapes) > c.effect.placed


def _combined(table: Gram, units: Sequence[Unit], size: int, most: int) -> list[tuple[Unit, ...]]:
    """Return the sets of `size` units that do not clash and count as at most `most`."""
    index = np.array(list(combinations(range(len(units)), size)), int).reshape(-1, size)
    weight = np.array([table.candidates[u.members[0]].effect.weight for u in units])
    clash = _clash_matrix(table, units)
    good = weight[index].sum(axis=1) <= most
    for i, j in combinations(range(size), 2):
        good &= ~clash[index[:, i], index[:, j]]
    return [tuple(units[i] for i in row) for row in index[good].tolist()]


def _mixed(
    table: Gram, grouped: Sequence[Unit], singles: Sequence[Unit], most: int
) -> list[tuple[Unit, ...]]:
    """Return two groups with one single candidate."""
    held = [*grouped, *singles[:_BESIDE_GROUPS]]
    sets = _combined(table, held, 3, most)
    return [s for s in sets if sum(u.group is not None for u in s) == 2]


def _clash_matrix(table: Gram, units: Sequence[Unit]) -> Bool[np.ndarray, "u u"]:
    """Return which units name one effect at one site, or an effect and one that contains it."""
    keys: list[set[tuple[str, str]]] = []
    within: list[set[tuple[str, str]]] = []
    for u in units:
        held = [table.candidates[i] for i in u.members]
        keys.append({k for c in held for k in c.exclusive_keys})
        within.append({(c.effect.nested, c.site.name) for c in held if c.effect.nested})
    out = np.zeros((len(units), len(units)), bool)
    for i, j in combinations(range(len(units)), 2):
        clash = keys[i] & keys[j] or within[i] & keys[j] or within[j] & keys[i]
        out[i, j] = out[j, i] = bool(clash)
    return out


def _within_bounds(table: Gram, unit: Unit) -> Unit | None:
    """Return a group without the members whose estimates are beyond their bounds.

    None where fewer than two of them remain.
    """
    members = [
        i for i in unit.members if len(table.columns[i]) and table.alive[table.columns[i]].all()
    ]
    while len(members) > 1:
        index = np.concatenate([table.columns[i] for i in members])
        x = np.linalg.solve(table.G[np.ix_(index, index)], table.b[index])
        ends = np.cumsum([len(table.columns[i]) for i in members])
        good = [bool(part.all()) for part in np.split(table.inside(x, index), ends[:-1])]
        if all(good):
            return replace(unit, members=tuple(members))
        members = [i for i, ok in zip(members, good, strict=True) if ok]
    return None


def _ranked(scored: Iterable[Scored]) -> list[Scored]:
    return sorted(scored, key=lambda s: -s.gain)
