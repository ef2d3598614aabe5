"""The plan of a suite: which case conceals what kind of physics on which machine.

The kinds are dealt out evenly; everything else (sites, magnitudes, noise, motion) is drawn case by
case from a seed of 128 bits. The generator is frozen by commit before any threshold of the
diagnosis is tuned: whoever changes what is drawn here or in `case` starts a new proof.
"""

import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil, floor
from typing import Any

import numpy as np

from bo_sysid.errors import StudyError
from bo_sysid.proof.suite import LoadedSuite

GROUPED = ("dry_friction", "viscous_damping", "armature")
"""Kinds that are concealed on all joints at once."""


@dataclass(frozen=True)
class Draw:
    """What one case is drawn from.

    Attributes:
        name: of the case; says nothing.
        seed: of everything that is drawn in it.
        tier: of its plant.
        machine: name of the machine.
        effects: ids of what it conceals.
        grouped: whether its one effect is on all joints.
        parameters: whether parameters are off their nominal values.
    """

    name: str
    seed: int
    tier: int
    machine: str
    effects: tuple[str, ...] = ()
    grouped: bool = False
    parameters: bool = False

    def plain(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> "Draw":
        """Return it from JSON."""
        return cls(**{**data, "effects": tuple(data["effects"])})


def plan(suite: LoadedSuite) -> tuple[Draw, ...]:
    """Draw the plan of a suite.

    Without a seed in the suite all randomness comes from the operating system, so that nobody can
    draw the same plan again.
    """
    seed = secrets.randbits(128) if suite.suite.seed is None else suite.suite.seed
    return _Dealer(suite, np.random.default_rng(seed)).deal()


class _Dealer:
    """Deals kinds of physics and machines evenly, in random order."""

    def __init__(self, suite: LoadedSuite, rng: np.random.Generator) -> None:
        self._loaded, self._suite, self._rng = suite, suite.suite, rng
        self._machines: Counter[str] = Counter()
        self._kinds: Counter[tuple[int, str]] = Counter()

    def deal(self) -> tuple[Draw, ...]:
        """Return the cases, shuffled, with names in that order.

        Raises:
            StudyError: something is to be missing, and nothing of the suite can be.
        """
        rng, suite = self._rng, self._suite
        nothing = ceil(suite.nothing * suite.cases - 1e-9)
        contents: list[tuple[int, str, tuple[str, ...], bool]] = []
        for tier, count in _shares(self._weights(TIERS_OF_NOTHING), nothing).items():
            contents += [(tier, self._machine(tier), (), False) for _ in range(count)]
        weights = self._weights((2, 3, 4))
        if nothing < suite.cases and not all(self._loaded.ids(t) for t in weights):
            raise StudyError(
                f"suite {suite.name}: none of its effects can be concealed in its tiers on its "
                "machines; name others, or nothing: 1"
            )
        for tier, count in _shares(weights, suite.cases - nothing).items():
            contents += self._missing(tier, count)
        rng.shuffle(contents)
        off = rng.permutation(len(contents)) < round(suite.parameters * len(contents))
        digits = len(str(len(contents)))
        return tuple(
            Draw(
                f"case-{k + 1:0{digits}d}",
                int.from_bytes(rng.bytes(16), "big"),
                tier,
                machine,
                effects,
                grouped,
                bool(off[k]) and bool(self._loaded.machines[machine].file.parameters),
            )
            for k, (tier, machine, effects, grouped) in enumerate(contents)
        )

    def _weights(self, tiers: Sequence[int]) -> dict[int, float]:
        """Return the weights of the tiers for which there is something."""
        weights = {t: float(self._suite.tiers.get(t, 0.0)) for t in tiers}
        able = {t: w for t, w in weights.items() if w > 0 and self._loaded.ids(t)}
        return able or {2: 1.0}

    def _missing(self, tier: int, count: int) -> list[tuple[int, str, tuple[str, ...], bool]]:
        suite = self._suite
        found: list[tuple[int, str, tuple[str, ...], bool]] = []
        known = tier != 4
        pairs = round(suite.pairs * count) if known else 0
        able = known and any(i in GROUPED for i in self._loaded.ids(tier))
        groups = round(suite.groups * count) if able else 0
        for k in range(count):
            grouped = k < groups
            id = self._kind(
                tier, [i for i in self._loaded.ids(tier) if not grouped or i in GROUPED]
            )
            machine = self._machine(tier, self._loaded.fitting(id, tier))
            effects: tuple[str, ...] = (id,)
            if groups <= k < groups + pairs:
                others = [
                    i
                    for i in self._loaded.ids(tier)
                    if i != id and machine in self._loaded.fitting(i, tier)
                ]
                effects = (id, self._kind(tier, others)) if others else effects
            found.append((tier, machine, effects, grouped))
        return found

    def _kind(self, tier: int, ids: Sequence[str]) -> str:
        """Return one of the kinds that were dealt least, at random."""
        least = min(self._kinds[tier, i] for i in ids)
        id = str(self._rng.choice([i for i in ids if self._kinds[tier, i] == least]))
        self._kinds[tier, id] += 1
        return id

    def _machine(self, tier: int, among: Sequence[str] | None = None) -> str:
        """Return one of the machines that were dealt least, at random."""
        able = [n for n, m in self._loaded.machines.items() if tier in m.tiers]
        able = [n for n in able if among is None or n in among]
        least = min(self._machines[n] for n in able)
        name = str(self._rng.choice([n for n in able if self._machines[n] == least]))
        self._machines[name] += 1
        return name


TIERS_OF_NOTHING = (2, 3)


def _shares(weights: Mapping[int, float], count: int) -> dict[int, int]:
    """Share out a count in proportion to weights, by largest remainder."""
    total = sum(weights.values())
    exact = {k: count * w / total for k, w in weights.items()}
    shares = {k: floor(x + 1e-9) for k, x in exact.items()}
    for k in sorted(exact, key=lambda k: shares[k] - exact[k])[: count - sum(shares.values())]:
        shares[k] += 1
    return shares
