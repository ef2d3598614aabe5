"""The search for the set of effects that explains the recordings.

Sets are proposed by linear algebra (`subsets`), fitted through the simulator (`refit`), and the
model is linearised anew at the leader until it no longer changes: additions, swaps, drops, finer
shapes. Where the nominal model is far off, short windows come first and the best sets are carried
to longer ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.fit import Fit, set_key
from bo_sysid.diagnosis.hypothesis import Candidate, Hypothesis
from bo_sysid.diagnosis.linear import Linear, linearise
from bo_sysid.diagnosis.refit import FINAL, Effort, refit
from bo_sysid.diagnosis.rules import (
    CLEAN,
    MARGIN,
    ROUGH,
    SHARE,
    Prior,
    clean,
    ranked,
)
from bo_sysid.diagnosis.screen import Screen
from bo_sysid.diagnosis.subsets import Scored, clashes, groups, search
from bo_sysid.diagnosis.units import alone, grouped_labels, subset, units_of, with_group
from bo_sysid.diagnosis.windowing import Prepared
from bo_sysid.simulation import State

_TOP = {1: 5, 2: 5, 3: 3}  # sets of each size that are fitted in the first round
_TOP_GROUPED = {1: 3, 2: 3, 3: 3}
_ALIKE = 30.0  # [sigma²] of linear gain within which another effect may be equivalent
_NEARLY = 1e-3  # of the gain, what a linear estimate of it may be off
_ROUGHLY = 0.01  # the same where the fit is far from the recordings
_SUBSTITUTES = 5
_NEAR = 0.03  # a linear estimate of a threshold this close to its grid point is believed
_HOPEFUL = 1.5  # times the least rms up to which a fit far off is linearised at itself
_AFRESH, _BETTER = 4, 0.97  # times that it is, while the rms falls below this share


@dataclass
class Search:
    """Fits found so far on one set of windows; the only mutable value of the diagnosis.

    Attributes:
        prepared: the windows.
        candidates: everything that may be missing; finer shapes are added.
        most: most effects in a set.
        prior: of sets.
        frame: the linear model at the present leader.
        fits: by identity of their set.
    """

    prepared: Prepared
    candidates: list[Candidate]
    most: int
    prior: Prior
    frame: Linear
    fits: dict[frozenset[tuple[object, ...]], Fit] = field(default_factory=dict)
    _screen: Screen | None = None

    @classmethod
    def on(
        cls, prepared: Prepared, candidates: list[Candidate], most: int, guess: Hypothesis | None
    ) -> "Search":
        """Begin on prepared windows; `guess` gives first values of the nuisances."""
        prior = Prior(len({c.key for c in candidates}), len(groups(candidates)))
        made = cls(prepared, candidates, most, prior, prepared.linear)
        made.fit((), (), guess=guess)
        return made

    @property
    def nominal(self) -> Fit:
        """The fit of nothing."""
        return self.fits[frozenset()]

    @property
    def best(self) -> Fit:
        """The leading fit."""
        return ranked(self.fits.values(), self.prior)[0]

    @property
    def least(self) -> float:
        """The least rms of all fits."""
        return min((f.rms for f in self.fits.values()), default=np.inf)

    @property
    def begun(self) -> bool:
        """Whether anything was tried yet."""
        return self._screen is not None

    def fit(
        self,
        members: Sequence[Candidate],
        x: Sequence[Float[np.ndarray, " _"]],
        *,
        start: State | None = None,
        guess: Hypothesis | None = None,
        again: bool = False,
        effort: Effort | None = None,
    ) -> Fit:
        """Fit a set, or return the fit that there is; the better one is kept."""
        key = set_key(members)
        known = self.fits.get(key)
        if known is not None and not again:
            return known
        effort = effort or Effort(rival=self.least)
        labels = grouped_labels(members, self.candidates)
        first = [x] + ([] if again else self._other_starts(members, x))
        found = known
        for k, begin in enumerate(first):
            if k and found is not None and clean(found):
                break
            made = refit(
                self.frame,
                members,
                [self._begin(c, v) for c, v in zip(members, begin, strict=True)]
                if not again
                else begin,
                groups=labels,
                start=start or self.prepared.start,
                guess=guess,
                columns=self._first_jacobian(members) if not again else None,
                effort=effort,
            )
            made = self._afresh(made, labels, effort)
            if found is None or made.rss < found.rss:
                found = made
        assert found is not None  # noqa: S101 - there is always a first start
        self.fits[key] = self._not_worse(found, labels, effort)
        return self.fits[key]

    def _not_worse(self, fit: Fit, labels: tuple[str | None, ...], effort: Effort) -> Fit:
        """Fit once more from the best smaller set inside it, where that one is nearer."""
        inside = [f for f in self.fits.values() if f.key < fit.key and f.rss < fit.rss]
        if not inside or not effort.final:
            return fit
        best = min(inside, key=lambda f: f.rss)
        known = {set_key([c]): x for c, x in zip(best.members, best.x, strict=True)}
        x = [known.get(set_key([c]), np.zeros(c.size)) for c in fit.members]
        frame = linearise(self.prepared.problem, best.hypothesis, best.start)
        made = refit(
            frame, fit.members, x, groups=labels, start=best.start, guess=best.hypothesis,
            effort=effort,
        )  # fmt: skip
        return made if made.rss < fit.rss else fit

    def _afresh(self, fit: Fit, labels: tuple[str | None, ...], effort: Effort) -> Fit:
        """Fit on with the model linearised at the fit itself, where it is far from the data.

        The response to the starts changes with the set there, and a set that is not fitted to its
        end makes those that contain it look needed.
        """
        for _ in range(_AFRESH):
            far = fit.rms > ROUGH and (not fit.members or fit.rms < _HOPEFUL * self.least)
            if not far or not fit.hypothesis.free:
                break
            frame = linearise(self.prepared.problem, fit.hypothesis, fit.start)
            made = refit(
                frame, fit.members, fit.x, groups=labels, start=fit.start, guess=fit.hypothesis,
                effort=effort,
            )  # fmt: skip
            better, fit = made.rms < _BETTER * fit.rms, made if made.rss < fit.rss else fit
            if not better:
                break
        return fit

    def round(self, base: Fit) -> None:
        """Linearise at a fit and try what could be added to it, exchanged or left out."""
        self.simplify(base)
        self._vary(base)
        self._refine(base)
        screen = self._screened(base)
        if not base.members:
            self._first(screen)
            return
        if not clean(base):  # with the response to the start at this fit
            again = self.fit(
                base.members, base.x, start=base.start, guess=base.hypothesis, again=True,
            )  # fmt: skip
            if again.rms < 0.97 * base.rms:
                return self.round(again)
        self._add(screen, base)
        for unit in units_of(base):
            self._exchange(screen, base, unit)
            self._drop(base, unit)

    def _first(self, screen: Screen) -> None:
        found = search(screen.gram((), {}), self.most, groups(self.candidates))
        self._run(alone(found.get(1, [])), _TOP[1], None)
        self._vary(self.best)
        for size in (1, 2, 3):
            if self.least**2 - 1 <= CLEAN:
                return
            sets = found.get(size, [])
            self._run(with_group(sets), _TOP_GROUPED[size], None)
            if size > 1:
                self._run(alone(sets), _TOP[size], None)

    def _add(self, screen: Screen, base: Fit) -> None:
        room = self.most - base.size
        if room <= 0:
            return
        fixed = [self.candidates.index(c) for c in base.members]
        now = dict(zip(fixed, base.x, strict=True))
        units = groups(self.candidates) if not clean(base) else ()
        found = search(screen.gram(fixed, now), room, units, deepest=2, paired=60)
        need = max(0.7 * MARGIN, 0.5 * SHARE * np.sqrt(base.excess))
        self._run(alone(found[1]), 3, base, need=need)
        self._run(with_group(found[1]), 2, base, need=need)
        if room > 1 and not clean(base):
            self._run(alone(found.get(2, [])), 2, base, need=need)

    def _exchange(self, screen: Screen, base: Fit, unit: tuple[int, ...]) -> None:
        """Try others in the place of one unit of a fit."""
        rest = [k for k in range(len(base.members)) if k not in unit]
        members, x = subset(base, rest)
        fixed = [self.candidates.index(c) for c in members]
        now = dict(zip(fixed, x, strict=True))
        without = screen.without([base.members[k] for k in unit], [base.x[k] for k in unit])
        many = len(units_of(base)) < 3 and not clean(base)
        units = groups(self.candidates) if not clean(base) else ()
        room = self.most - base.size + base.members[unit[0]].effect.weight
        deepest = 2 if many else 1
        found = search(without.gram(fixed, now), room, units, deepest=deepest, paired=60)
        self._run(alone(found[1]), 2 if clean(base) else 3, base, rest)
        self._run(with_group(found[1]), 1, base, rest)
        if many:
            self._run(alone(found.get(2, [])), 1, base, rest)

    def substitute(self, base: Fit) -> None:
        """Fit what could stand in the place of a member and explain as much."""
        screen = self._screened(base)
        near = _ALIKE * max(1.0, base.rms**2)
        rough = _ROUGHLY if base.rms > ROUGH else _NEARLY
        for k, member in enumerate(base.members):
            rest = [i for i in range(len(base.members)) if i != k]
            members, x = subset(base, rest)
            fixed = [self.candidates.index(c) for c in members]
            without = screen.without([member], [base.x[k]])
            found = search(without.gram(fixed, dict(zip(fixed, x, strict=True))), 1)[1]
            own = max((s.gain for s in found if self.candidates[s.members[0]] is member), default=0)
            alike = [s for s in found if s.gain > own - max(near, rough * own)]
            self._run(alike, _SUBSTITUTES, base, rest, effort=replace(FINAL, rival=base.rms))

    def _drop(self, base: Fit, unit: tuple[int, ...]) -> None:
        sets = [unit] if len(unit) == 1 else [unit, *((k,) for k in unit)]
        for out in sets:
            rest = [k for k in range(len(base.members)) if k not in out]
            self.fit(*subset(base, rest), start=base.start, again=True)

    def _run(
        self,
        scored: Sequence[Scored],
        top: int,
        base: Fit | None,
        kept: Sequence[int] | None = None,
        need: float = 0.0,
        effort: Effort | None = None,
    ) -> None:
        """Fit the best of the scored sets, on top of the kept members of a fit."""
        seen: set[frozenset[tuple[str, str]]] = set()
        dof = self.prepared.problem.dof
        held: tuple[Sequence[Candidate], Sequence[np.ndarray]] = ((), ())
        if base is not None:
            held = subset(base, range(len(base.members)) if kept is None else kept)
        for s in scored:
            members = [self.candidates[i] for i in s.members]
            key = frozenset(c.key for c in members)
            if key in seen:
                continue
            seen.add(key)
            if len(seen) > top or np.sqrt(max(s.gain, 0.0) / dof) < need:
                return
            if clashes([*held[0], *members]):
                continue
            x = np.split(s.x, np.cumsum([c.size for c in members])[:-1])
            self.fit(
                (*held[0], *members),
                (*held[1], *x),
                start=base.start if base is not None else None,
                guess=base.hypothesis if base is not None else None,
                effort=effort,
            )

    def _vary(self, base: Fit) -> None:
        """Fit a set that leaves something with other shapes of its effects, all sites alike."""
        if clean(base):
            return
        for effect in dict.fromkeys(c.effect for c in base.members if c.extent.variants):
            own = [c for c in base.members if c.effect is effect]
            for k in range(len(own[0].extent.variants)):
                members = [
                    c.with_shapes(np.array(c.extent.variants[k])) if c.effect is effect else c
                    for c in base.members
                ]
                if set_key(members) not in self.fits:
                    known = [self._known(c) for c in members]
                    self.fit(known, base.x, start=base.start, guess=base.hypothesis)

    def _known(self, candidate: Candidate) -> Candidate:
        """Return a candidate as it is listed; one that is new is added to the list."""
        present = {set_key([c]): c for c in self.candidates if not c.secant}
        if set_key([candidate]) not in present:
            self.candidates.append(candidate)
        return present.get(set_key([candidate]), candidate)

    def listed(self, fit: Fit) -> None:
        """Keep a fit, and its members among the candidates."""
        for c in fit.members:
            self._known(c)
        self.fits[fit.key] = fit

    def simplify(self, fit: Fit, effort: Effort | None = None) -> None:
        """Fit a set with the simpler effect in the place of each that contains one."""
        for k, c in enumerate(fit.members):
            plain = self._plainer(c) if fit.unique[k] < 1.0 or effort else None
            if plain is not None:
                members = (*fit.members[:k], plain, *fit.members[k + 1 :])
                x = (*fit.x[:k], fit.x[k][1:], *fit.x[k + 1 :])
                if not clashes(members):
                    self.fit(members, x, start=fit.start, guess=fit.hypothesis, effort=effort)

    def _plainer(self, c: Candidate) -> Candidate | None:
        wanted = (c.effect.nested, c.site.name)
        return next((d for d in self.candidates if d.key == wanted), None)

    def _refine(self, base: Fit) -> None:
        """Add finer shapes of the members of a fit to the candidates."""
        present = {set_key([c]) for c in self.candidates}
        for c in base.members:
            turns = self.prepared.problem.machine.joint_of(c.site.kind, c.site.name)
            whole = turns is not None and turns.hinge and c.effect.vector > 1
            if whole and clean(base):
                continue  # periods in a turn are whole numbers
            for factor in c.extent.refine:
                made = c.with_shapes(c.shapes * factor)
                if set_key([made]) not in present:
                    self.candidates.append(made)

    def _screened(self, base: Fit) -> Screen:
        """Linearise the model at a fit, and return what every candidate would do there."""
        if base.members or self.begun:
            self.frame = linearise(self.prepared.problem, base.hypothesis, base.start)
        self._screen = Screen.at(base, self.frame, self.candidates)
        return self._screen

    def _first_jacobian(self, members: Sequence[Candidate]) -> np.ndarray | None:
        return None if self._screen is None else self._screen.jacobian(members)

    def _begin(self, c: Candidate, x: np.ndarray) -> np.ndarray:
        """Return where a fit begins: thresholds act near the point of their grid only."""
        if c.effect.threshold and abs(x[0] / c.point[0] - 1) > _NEAR:
            return c.point[: c.size]
        return x

    def _other_starts(
        self, members: Sequence[Candidate], x: Sequence[np.ndarray]
    ) -> list[list[np.ndarray]]:
        found = []
        for k, c in enumerate(members):
            for s in c.extent.starts:
                found.append([*x[:k], np.array(s[: c.size], float), *x[k + 1 :]])
        return found
