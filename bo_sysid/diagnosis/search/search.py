"""The search for the set of effects that explains the recordings: the fits found so far.

Sets are proposed and fitted in `rounds`, the model linearised anew at the leader until it no longer
changes. Where the nominal model is far off, short windows come first and the best sets are carried
to longer ones (`moves`, `locate`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import grouped_labels
from bo_sysid.diagnosis.sets.refit import Effort, refit, refit_at
from bo_sysid.diagnosis.sets.rules import SetPrior, clean, ranked
from bo_sysid.diagnosis.sets.screen import Screen
from bo_sysid.diagnosis.sets.subsets import groups
from bo_sysid.diagnosis.windows.candidate import Candidate, orders
from bo_sysid.diagnosis.windows.estimated_starts import on_the_right_side
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.windowing import Prepared
from bo_sysid.simulation import State

_NEAR = 0.03  # a linear estimate of a threshold this close to its grid point is believed
# times the least rms so far, up to which a set far from the recordings is linearised at itself
_HOPEFUL = 1.5
_ACROSS = 2.0  # the same, for a set with a joint in a gap
_ALIKE = 0.1  # relative difference of rms within which the linear model at one set serves another
# rms of a set with a gap, and of any other, at which the search is over
_NEARLY, _CLEAR = 1.05, 1.02
# rounds of linearising anew at most, each of which must leave less than this share
_AFRESH, _BETTER = 4, 0.97


@dataclass
class Search:
    """Fits found so far on one set of windows; it grows as sets are fitted.

    Attributes:
        prepared: the windows.
        candidates: everything that may be missing; finer shapes are added.
        most: most effects in a set.
        prior: of sets.
        frame: the linear model at the present leader.
        fits: by identity of their set.
        placed: identities of the sets in which the place of a load was fitted.
        doing: told after every fit how far the search is.
    """

    prepared: Prepared
    candidates: list[Candidate]
    most: int
    prior: SetPrior
    frame: Linear
    fits: dict[frozenset[tuple[object, ...]], Fit] = field(default_factory=dict)
    placed: set[frozenset[tuple[object, ...]]] = field(default_factory=set)
    doing: Callable[[str], None] = lambda text: None
    _screen: Screen | None = None
    _framed: float = np.inf  # rms of the fit at which the frame was taken
    _inside: tuple[Fit, Linear] | None = None  # the last set inside others, linearised there

    @classmethod
    def on(
        cls,
        prepared: Prepared,
        candidates: list[Candidate],
        most: int,
        guess: Hypothesis | None,
        doing: Callable[[str], None] = lambda text: None,
    ) -> "Search":
        """Begin on prepared windows; `guess` gives first values of the nuisances."""
        prior = SetPrior(len({c.key for c in candidates}), len(groups(candidates)))
        made = cls(prepared, candidates, most, prior, prepared.linear, doing=doing)
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
    def nearest(self) -> Fit:
        """The set that leaves least, of those that were fitted; there must be one."""
        return min(self.fits.values(), key=lambda f: f.rms)

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
        across: bool = False,
        effort: Effort | None = None,
    ) -> Fit:
        """Fit a set, also from other magnitudes than `x`, or return the fit that there is.

        With `across`, from starts on either side of gaps (`_in_gaps`), which takes its time.
        """
        known = self.fits.get(set_key(members))
        if known is not None:
            return known
        effort = effort or Effort(rival=self.least)
        begins = [x, *self._other_magnitudes(members, x)]
        found: list[Fit] = []
        while begins and not any(clean(f) for f in found):
            near = [self._begin(c, v) for c, v in zip(members, begins.pop(0), strict=True)]
            columns = self._first_jacobian(members)
            found.append(self._fitted(members, near, start, guess, effort, across, columns))
        return self._kept(min(found, key=lambda f: f.rss), effort)

    def refit(
        self,
        members: Sequence[Candidate],
        x: Sequence[Float[np.ndarray, " _"]],
        *,
        start: State | None = None,
        guess: Hypothesis | None = None,
        across: bool = False,
        effort: Effort | None = None,
    ) -> Fit:
        """Fit a set from these magnitudes, whatever fit there is of it; the better one is kept."""
        effort = effort or Effort(rival=self.least)
        made = self._fitted(members, list(x), start, guess, effort, across)
        known = self.fits.get(made.key)
        return self._kept(known if known is not None and known.rss <= made.rss else made, effort)

    def _fitted(
        self,
        members: Sequence[Candidate],
        x: list[Float[np.ndarray, " _"]],
        start: State | None,
        guess: Hypothesis | None,
        effort: Effort,
        across: bool,
        columns: np.ndarray | None = None,
    ) -> Fit:
        made = refit(
            self.frame, members, x, groups=grouped_labels(members, self.candidates),
            start=start or self.prepared.start, guess=guess, columns=columns, effort=effort,
        )  # fmt: skip
        made = self._afresh(made, effort)
        return self._in_gaps(made, effort) if across else made

    def _kept(self, fit: Fit, effort: Effort) -> Fit:
        """Keep a fit, bettered from beside saddles, in other orders and from a set inside it."""
        kept = self._not_worse(self._in_turn(self._off_saddles(fit, effort), effort), effort)
        self.fits[kept.key] = kept
        windows, instants = self.prepared.problem.windows.observed.shape[:2]
        sets = "set" if len(self.fits) == 1 else "sets"
        self.doing(
            f"{len(self.fits)} {sets} fitted to {windows} windows of {instants} instants, the "
            f"nearest leaves {self.least:.3f} sigma"
        )
        return kept

    def _not_worse(self, fit: Fit, effort: Effort) -> Fit:
        """Fit once more from the best smaller set inside it, where that one is nearer."""
        inside = [f for f in self.fits.values() if f.key < fit.key and f.rss < fit.rss]
        if not inside or not effort.final:
            return fit
        best = min(inside, key=lambda f: f.rss)
        known = {set_key([c]): x for c, x in zip(best.members, best.x, strict=True)}
        x = [known.get(set_key([c]), np.zeros(c.size)) for c in fit.members]
        made = refit(
            self._frame_of(best), fit.members, x, groups=fit.groups, start=best.start,
            guess=best.hypothesis, effort=effort,
        )  # fmt: skip
        return made if made.rss < fit.rss else fit

    def _frame_of(self, fit: Fit) -> Linear:
        """Return the model linearised at a fit; one after the other asks for it at the same one."""
        if self._inside is None or self._inside[0] is not fit:
            frame = linearise(self.prepared.problem, fit.hypothesis, fit.start)
            self._inside = fit, frame
        return self._inside[1]

    def _afresh(self, fit: Fit, effort: Effort) -> Fit:
        """Fit on with the model linearised at the fit itself, where it is far from the data.

        The response to the starts changes with the set there, and a set that is not fitted to its
        end makes those that contain it look needed. It is much the same for sets that leave as much
        as the one at which the model was linearised, but not where a set adds a spring that swings:
        of that a model without it knows nothing.
        """
        springy = any(c.effect.hidden for c in fit.members)
        springy = springy and not self.prepared.problem.loose(fit.hypothesis)
        if abs(fit.rms / self._framed - 1) < _ALIKE and not springy:
            return fit
        for _ in range(_AFRESH):
            far = fit.rms > ROUGH or (springy and not clean(fit))
            hopeful = not fit.members or fit.rms < _HOPEFUL * self.least
            unfinished = springy and fit.rms > self.nominal.rms  # it leaves more than none
            if not (far and (hopeful or unfinished) and fit.hypothesis.free):
                break
            made = self._at_itself(fit, fit.start, effort)
            better, fit = made.rms < _BETTER * fit.rms, made if made.rss < fit.rss else fit
            if not better:
                break
        return fit

    def _off_saddles(self, fit: Fit, effort: Effort) -> Fit:
        """Fit on from beside what acts in second order there: no slope leads away from it."""
        best = fit
        for k, c in enumerate(fit.members):
            for other in c.off_saddles(fit.x[k]):
                if clean(best) or best.rms > _HOPEFUL * self.least:
                    return best
                made = refit(
                    self.frame, fit.members, [*best.x[:k], other, *best.x[k + 1 :]],
                    groups=fit.groups, start=best.start, guess=best.hypothesis, effort=effort,
                )  # fmt: skip
                best = made if made.rss < best.rss else best
        return best

    def _in_turn(self, fit: Fit, effort: Effort) -> Fit:
        """Fit what acts on one command in other orders as well; all are one set."""
        best = fit
        for order in orders(fit.members):
            if clean(best) or best.rms > _HOPEFUL * self.least:
                break
            members, x = [fit.members[k] for k in order], [fit.x[k] for k in order]
            made = refit(
                self.frame, members, x, groups=grouped_labels(members, self.candidates),
                start=fit.start, guess=fit.hypothesis, effort=effort,
            )  # fmt: skip
            best = made if made.rss < best.rss else best
        return best

    def _in_gaps(self, fit: Fit, effort: Effort) -> Fit:
        """Fit on from starts that are fitted to each window, where a joint moves in a gap.

        On which side of it a window begins is no small change of a start. Magnitudes that follow
        starts of one side alone, and those starts them, come to nothing.
        """
        problem = self.prepared.problem
        for _ in range(_AFRESH):
            done = fit.rms < _NEARLY or self.least < _CLEAR
            hopeful = fit.rms < _ACROSS * self.least and not done
            if not (hopeful and problem.loose(fit.hypothesis)):
                break
            start = on_the_right_side(problem, fit.hypothesis, fit.start)
            made = self._at_itself(fit, start, effort)
            better, fit = made.rms < _BETTER * fit.rms, made if made.rss < fit.rss else fit
            if not better:
                break
        return fit

    def _at_itself(self, fit: Fit, start: State, effort: Effort) -> Fit:
        """Fit on with the model linearised at the fit, from given starts."""
        frame = linearise(self.prepared.problem, fit.hypothesis, start)
        return refit_at(frame, fit, start=start, effort=effort)

    def known(self, candidate: Candidate) -> Candidate:
        """Return a candidate as it is listed; one that is new is added to the list."""
        present = {set_key([c]): c for c in self.candidates if not c.secant}
        if set_key([candidate]) not in present:
            self.candidates.append(candidate)
        return present.get(set_key([candidate]), candidate)

    def listed(self, fit: Fit) -> None:
        """Keep a fit, and its members among the candidates, which are told apart by identity."""
        members = tuple(self.known(c) for c in fit.members)
        hypothesis = replace(fit.hypothesis, members=members)
        self.fits[fit.key] = replace(fit, hypothesis=hypothesis)

    def screened(self, base: Fit) -> Screen:
        """Linearise the model at a fit, and return what every candidate would do there."""
        if base.members or self.begun:
            self.frame = linearise(self.prepared.problem, base.hypothesis, base.start)
            self._framed = base.rms
        self._screen = Screen.at(base, self.frame, self.candidates)
        return self._screen

    def _first_jacobian(self, members: Sequence[Candidate]) -> np.ndarray | None:
        return None if self._screen is None else self._screen.jacobian(members)

    def _begin(self, c: Candidate, x: np.ndarray) -> np.ndarray:
        """Return where a fit begins: thresholds act near the point of their grid only."""
        if c.effect.threshold and abs(x[0] / c.point[0] - 1) > _NEAR:
            return c.point[: c.size]
        return x

    def _other_magnitudes(
        self, members: Sequence[Candidate], x: Sequence[np.ndarray]
    ) -> list[list[np.ndarray]]:
        """Return the same magnitudes with another start of one member in each."""
        return [
            [*x[:k], other, *x[k + 1 :]]
            for k, c in enumerate(members)
            if not c.effect.hidden
            for other in c.other_starts
        ]
