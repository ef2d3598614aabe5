"""Sets of effects as units: one effect, or a group of them at several sites."""

from collections.abc import Collection, Sequence

import numpy as np

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.subsets import Scored, groups
from bo_sysid.diagnosis.windows.candidate import Candidate


def units_of(fit: Fit) -> list[tuple[int, ...]]:
    """Return the members of each unit of a fit: one member, or all of a group."""
    found: list[tuple[int, ...]] = [(k,) for k, g in enumerate(fit.groups) if g is None]
    for label in dict.fromkeys(g for g in fit.groups if g is not None):
        found.append(tuple(k for k, g in enumerate(fit.groups) if g == label))
    return found


def units_beyond(fit: Fit, other: Fit) -> list[list[int]]:
    """Return the members that a fit has and another lacks, those of a group together."""
    shared = {c.key for c in other.members}
    own = ([k for k in unit if fit.members[k].key not in shared] for unit in units_of(fit))
    return [unit for unit in own if unit]


def grouped_labels(
    members: Sequence[Candidate], candidates: Sequence[Candidate]
) -> tuple[str | None, ...]:
    """Return the effect of each member's group: found on at least two, and half, of its sites."""
    sites = {u.group: len(u.members) for u in groups(candidates)}
    held = [c.effect.id for c in members]
    return tuple(e if held.count(e) >= max(2.0, 0.5 * sites.get(e, np.inf)) else None for e in held)


def subset(fit: Fit, keep: Sequence[int]) -> tuple[tuple[Candidate, ...], tuple[np.ndarray, ...]]:
    """Return some members of a fit and their magnitudes."""
    return tuple(fit.members[k] for k in keep), tuple(fit.x[k] for k in keep)


def all_but(fit: Fit, out: Collection[int]) -> list[int]:
    """Return the places of all members of a fit but for some."""
    return [k for k in range(len(fit.members)) if k not in out]


def alone(scored: Sequence[Scored]) -> list[Scored]:
    """Return the sets without a group."""
    return [s for s in scored if all(u.group is None for u in s.units)]


def with_group(scored: Sequence[Scored]) -> list[Scored]:
    """Return the sets with a group."""
    return [s for s in scored if any(u.group is not None for u in s.units)]
