"""Starts of windows that are being fitted.

The prior lies about what a fit begins from: a smoother's estimate, or starts fitted before. Every
window is a least-squares problem of its own, and is simulated only as long as it has not settled.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.diagnosis.windows.coordinates import Coordinates
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import Force
from bo_sysid.effects.machine import JointScale
from bo_sysid.mjcf.touching import joints_to_contact
from bo_sysid.simulation import State
from bo_sysid.simulation.bristles import bristle_motors

DIVERGING = 1e9
"""Response to the start above which a window's simulation diverges."""

_ROUNDS = 5  # Gauss-Newton rounds; every other one linearises anew
_SHARES = (1.0, 0.3, 0.06)  # of a Gauss-Newton step, tried one after the other
_SETTLED = 0.05  # [sigma²] a start whose next step promises to gain less stays where it is
_GROWING = (0.25, 0.5, 1.0)  # shares of a window that its start is fitted to, one after the other
_DRAWS, _DRAWN = 32, 2  # starts drawn for a window in contact; how many of the best are then fitted
# a drawn start is fitted where it costs at most this many times what the present one does
_HOPEFUL = 20.0
_LEFT_BEHIND = 1.5  # [sigma²] mean square from which a window in contact is fitted on
_ASTRAY = 2.0  # times the median level, from which a window begins anew from what was recorded
_BEHIND = 4.0  # times the usual level, from which a window is fitted once more
_DIFFERENCE = 0.03  # finite-difference step of a start, as a share of its prior's deviation
# deviation of a start's prior: in sigma; as a share of the joint's typical speed
_POSITION, _SPEED = 30.0, 0.3
_ASIDE = 1e-3  # added to that, as a share of the spread of the joint's position: models are coarser
# deviation of the prior of a joint that the hypothesis added, as a share of that spread
_ADDED = 0.1
_LEAST = 1e-12  # the same at least, of a joint that cannot move
_STILL = 1e-6  # factor on the prior of a joint that is kept at rest
_SLOW = 1.0  # share of the joint's typical speed below which friction may hold it


def prior(problem: Problem, coordinates: Coordinates) -> Float[np.ndarray, " n"]:
    """Return how far the start may lie from a smoother's estimate, position then velocity.

    What a hypothesis added may lie as far from where it rests, and no further than it can go.
    """
    nv = problem.machine.model.nv
    position, speed = np.full(nv, 1e3), np.full(nv, 1e3)
    spread = np.zeros(nv)
    for joint in problem.machine.joints.values():
        speed[joint.dof], spread[joint.dof] = _SPEED * joint.speed, joint.spread
    for dof, sigma in _recorded(problem):
        position[dof] = _POSITION * sigma + _ASIDE * spread[dof]
    own = [s.qvel for s in coordinates.second]
    most = np.array([s.most for s in coordinates.second])
    places = np.minimum(_ADDED * spread[own], np.maximum(most, _LEAST))
    return np.concatenate([position, speed, places, speed[own]])


def start_noise(problem: Problem) -> Float[np.ndarray, " n"]:
    """Return how unsure a smoother's start is at most: sigma of a position, and of its rate.

    A rate from five samples is as unsure as sigma over the sampling interval (the slope of a cubic
    at their middle has √130 / 12 of it). Coordinates that are not recorded are held.
    """
    nv = problem.machine.model.nv
    noise = np.zeros(2 * nv)
    for dof, sigma in _recorded(problem):
        noise[[dof, nv + dof]] = sigma, sigma / problem.machine.sampling
    return noise


def _recorded(problem: Problem) -> Iterator[tuple[int, float]]:
    """Yield the degree of freedom and the sigma of each recorded position of a joint."""
    channels, layout = problem.windows.channels, problem.layout
    weight = problem.weight.reshape(-1, len(channels)).max(axis=0)
    for name, most in zip(channels, weight, strict=True):
        if name in layout.qpos and most > 0:
            dof = int(layout.velocity[layout.qpos[name]])
            if dof >= 0:
                yield dof, float(1 / most)


class FittedStarts:
    """Starts that are being fitted, with their residuals and costs."""

    def __init__(
        self,
        problem: Problem,
        hypothesis: Hypothesis,
        start: State,
        finer: int,
        still: int | None = None,
        worth: float = 0.0,
    ) -> None:
        """Begin at given starts.

        Args:
            problem: the windows.
            hypothesis: simulates.
            start: first starts.
            finer: divides the time step.
            still: a coordinate of the velocity that keeps its value.
            worth: share of what a window leaves beyond noise, that a step must promise.
        """
        self._problem, self._hypothesis, self._worth = problem, hypothesis, worth
        self._finer, self.start, self._still = finer, start.closed(problem.loops), still
        everything = np.arange(len(start))
        self.residual = self._residual(everything, self.start)
        self.cost = (self.residual**2).sum(axis=1)
        self._anchor = self.start

    @property
    def level(self) -> Float[np.ndarray, " W"]:
        """The cost of each window per observation, of which it may have few beside others."""
        return np.asarray(self.cost / self._problem.seen_in_each)

    def tried(self, rows: Int[np.ndarray, " L"], start: State, still: int | None = None) -> None:
        """Fit some windows from other starts, and take what costs less."""
        problem = self._problem.rows(rows)
        other = FittedStarts(problem, self._hypothesis, start, self._finer, still, self._worth)
        other.fit()
        self._adopt(rows, other)

    def left_behind(self, *, anywhere: bool = False) -> Int[np.ndarray, " L"]:
        """Return the windows that leave more than noise: in all, or `anywhere` in one channel."""
        seen = self._problem.weight > 0
        left, count = (self.residual.reshape(seen.shape) ** 2).sum(axis=1), seen.sum(axis=1)
        if not anywhere:
            left, count = (n.sum(axis=1, keepdims=True) for n in (left, count))
        return np.flatnonzero((left > _LEFT_BEHIND * count).any(axis=1))

    def refit_from_recorded(self) -> None:
        """Fit windows that leave much more than others from the smoother on, joints at rest or not.

        Their starts followed magnitudes that were far off, to where no small step leads back.
        """
        rows = self.left_behind()
        rows = rows[self.level[rows] > _ASTRAY * np.median(self.level)]
        if rows.size:
            problem = self._problem.rows(rows)
            start = problem.smoothed(self._hypothesis)
            other = FittedStarts(problem, self._hypothesis, start, self._finer, worth=self._worth)
            other.fit()
            other.rested()
            self._adopt(rows, other)

    def rested(self, *, half: bool = False) -> None:
        """Try slow joints that friction may hold at rest, where windows leave more than noise.

        From the smoother's starts, then from these; with the joint kept at rest as well, since the
        slopes of one that slips, taken beside it, mislead those that move it.

        Args:
            half: only in the half of the windows that leaves more.
        """
        smooth = self._problem.smoothed(self._hypothesis)
        for joint in held_joints(self._problem, self._hypothesis):
            rows = self.left_behind(anywhere=True)
            rows = rows[self.level[rows] >= np.median(self.level)] if half else rows
            slow = rows[np.abs(smooth.qvel[rows, joint.dof]) < _SLOW * joint.speed]
            if slow.size:
                self.tried(slow, _at_rest(smooth.rows(slow), joint))
                self.tried(slow, _at_rest(self.start.rows(slow), joint))
                self.tried(slow, _at_rest(self.start.rows(slow), joint), still=joint.dof)

    def grown(self) -> None:
        """Fit windows that leave more than noise to more and more of them, from the smoother on."""
        rows = self.left_behind()
        if not rows.size:
            return
        whole = self._problem.rows(rows)
        start = whole.smoothed(self._hypothesis)
        for share in _GROWING:
            part = whole.beginning(int(np.ceil(share * whole.windows.observed.shape[1])))
            other = FittedStarts(part, self._hypothesis, start, self._finer, worth=self._worth)
            other.fit()
            start = other.start
        self._adopt(rows, other)

    def multistart(self) -> None:
        """Fit windows that leave more than noise from starts drawn about the smoother's.

        Which foot lands first may hang on a milliradian. The slopes at a start lead no further than
        to where that changes, and a window whose true start lies beside the smoother's ends far
        from both. Draws are as wide as `start_noise`, the same for all windows.
        """
        rows = self.left_behind()
        if not rows.size:
            return
        unsure, at = start_noise(self._problem), np.arange(len(rows))
        move = np.random.default_rng(0).normal(size=(_DRAWS, len(unsure))) * unsure
        problem = self._problem.rows(np.tile(rows, _DRAWS))
        drawn = problem.moved(
            problem.smoothed(self._hypothesis), np.repeat(move, len(rows), axis=0)
        )
        left = (problem.residual(self._hypothesis, drawn, self._finer) ** 2).sum(axis=1)
        left = left.reshape(_DRAWS, len(rows))
        for best in np.argsort(left, axis=0)[:_DRAWN]:
            near = left[best, at] < _HOPEFUL * self.cost[rows]
            if near.any():
                self.tried(rows[near], drawn.rows((best * len(rows) + at)[near]))

    def _adopt(self, rows: Int[np.ndarray, " L"], other: "FittedStarts") -> None:
        """Take other starts of some windows where they cost less."""
        better = other.cost < self.cost[rows]
        won = rows[better]
        self.cost[won], self.residual[won] = other.cost[better], other.residual[better]
        self.start = self.start.placed(won, other.start.rows(better))

    def fit(self) -> None:
        """Gauss-Newton steps about the prior; each window leaves where it has settled.

        That is where a step promises no gain, or where no share of a step keeps one at a point
        that was just linearised.
        """
        busy = np.arange(len(self.start))
        for k in range(_ROUNDS):
            fresh = k % 2 == 0
            if fresh:
                self._linearise(busy, first=not k)
            step, gain = self._step(busy)
            excess = self.cost[busy] - self._problem.seen_in_each[busy]
            wanted = gain >= np.maximum(_SETTLED, self._worth * excess)
            moved = self._search(busy[wanted], step[wanted])
            busy = moved if fresh else busy[wanted]
            if not busy.size:
                break
        self._fit_stragglers()

    def _fit_stragglers(self) -> None:
        """Fit windows that are left far behind the others on, by differences of simulations.

        Where friction reverses right after the start, no slope along one motion tells of the next.
        """
        usual = max(float(np.median(self.level)), 1.0)
        busy = np.flatnonzero(self.level > _BEHIND * usual)
        for _ in range(_ROUNDS):
            if not busy.size:
                return
            self._use(busy, self._differences(busy))
            busy = self._search(busy, self._step(busy)[0])

    def _differences(self, busy: Int[np.ndarray, " B"]) -> Float[np.ndarray, "B R n"]:
        """Return the response to changes of the start that are a share of its prior."""
        sizes = _DIFFERENCE * self._spread
        away = self._away[busy] + np.diag(sizes)[:, None]  # n x B x n, simulated together
        rows = np.tile(busy, len(sizes))
        moved = self._problem.moved(self._anchor.rows(rows), away.reshape(len(rows), -1))
        r = self._problem.rows(rows).residual(self._hypothesis, moved, self._finer)
        change = self.residual[busy] - r.reshape(len(sizes), len(busy), -1)
        return np.asarray(np.moveaxis(change, 0, -1) / sizes)

    def _linearise(self, busy: Int[np.ndarray, " B"], first: bool) -> None:
        linear = linearise(self._problem.rows(busy), self._hypothesis, self.start.rows(busy))
        if first:
            self._spread = prior(self._problem, linear.points.coordinates)
            if self._still is not None:
                self._spread[self._problem.machine.model.nv + self._still] *= _STILL
            count, n = len(self.start), len(self._spread)
            self._away = np.zeros((count, n))
            self._J, self._gain = np.zeros((count, linear.J.shape[1], n)), np.zeros((count, n, n))
        self._use(busy, linear.J)

    def _use(self, busy: Int[np.ndarray, " B"], J: Float[np.ndarray, "B R n"]) -> None:
        """Take the response of some windows to their starts."""
        J = np.where((np.abs(J) < DIVERGING).all(axis=(1, 2), keepdims=True), J, 0.0)
        N = np.einsum("wri,wrj->wij", J, J) + np.diag(1 / self._spread**2)
        self._J[busy], self._gain[busy] = J, np.linalg.pinv(N, rcond=1e-15, hermitian=True)

    def _step(
        self, busy: Int[np.ndarray, " B"]
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, " B"]]:
        """Return the Gauss-Newton step of some windows and the gain that it promises."""
        g = np.einsum("wri,wr->wi", self._J[busy], self.residual[busy])
        g -= self._away[busy] / self._spread**2
        step = np.einsum("wij,wj->wi", self._gain[busy], g)
        return step, np.einsum("wi,wi->w", g, step)

    def _search(
        self, left: Int[np.ndarray, " L"], step: Float[np.ndarray, "L n"]
    ) -> Int[np.ndarray, " M"]:
        """Take the largest share of each step that lowers the cost; return what moved."""
        moved = np.zeros(len(self.start), bool)
        for share in _SHARES:
            if not left.size:
                break
            away = self._away[left] + share * step
            tried = self._problem.moved(self._anchor.rows(left), away)
            better = self._take(left, tried, ((away / self._spread) ** 2).sum(axis=1))
            self._away[left[better]], moved[left[better]] = away[better], True
            left, step = left[~better], step[~better]
        return np.flatnonzero(moved)

    def _take(
        self, rows: Int[np.ndarray, " L"], tried: State, penalty: Float[np.ndarray, " L"]
    ) -> Bool[np.ndarray, " L"]:
        """Take other starts of some windows where they cost less; return where."""
        r = self._residual(rows, tried)
        cost = (r**2).sum(axis=1) + penalty
        better = cost < self.cost[rows]
        won = rows[better]
        self.residual[won], self.cost[won] = r[better], cost[better]
        self.start = self.start.placed(won, tried.rows(better))
        return np.asarray(better)

    def _residual(self, rows: Int[np.ndarray, " L"], start: State) -> Float[np.ndarray, "L R"]:
        problem = self._problem if len(rows) == len(self.start) else self._problem.rows(rows)
        return problem.residual(self._hypothesis, start, self._finer)


def _at_rest(start: State, joint: JointScale) -> State:
    """Return the starts with a joint at rest."""
    qvel = start.qvel.copy()
    qvel[:, joint.dof] = 0.0
    return replace(start, qvel=qvel)


def held_joints(problem: Problem, hypothesis: Hypothesis) -> list[JointScale]:
    """Return the joints that friction, of a hypothesis or of a lasting contact, may hold at rest.

    Learned laws, which are held for a time step, turn smoothly: under them a joint creeps, and
    slopes lead from motion to rest.
    """
    model, parts = problem.compiled(hypothesis)
    bristles = model.actuator_trnid[bristle_motors(model), 0]
    names = {p.joint for p in parts if isinstance(p, Force) and not p.hold}
    if not problem.machine.impacts:
        names |= joints_to_contact(model)
    return [
        j
        for j in problem.machine.joints.values()
        if j.name in names
        or model.dof_frictionloss[model.joint(j.name).dofadr[0]] > 0
        or model.joint(j.name).id in bristles
    ]
