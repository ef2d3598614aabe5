"""What a log says for a hypothesis about its channels: the forces that it leaves unexplained."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.checks.balance import Dynamics, Terms, unexplained
from bo_sysid.checks.carriers import carriers
from bo_sysid.checks.hypothesis import Wire, WiringHypothesis
from bo_sysid.checks.traces import Traces
from bo_sysid.mjcf.commands import LAGS, controlled, driven_joint, follows
from bo_sysid.mjcf.joints import HINGE
from bo_sysid.simulation import Law, LawInputs

_SOME = 10  # one of so many instants is looked at where one would do
FLOOR = 1e-3  # what the model may leave unexplained of any balance

Laws = Mapping[str, tuple[Law, tuple[str, ...]]]
"""By actuator, the law that computes its control and the channels that it reads."""


class WiringEvidence:
    """Scores hypotheses about the recordings of one machine.

    The score is Σ_j log(J_j + 0.001) over the degrees of freedom that moved; lower is better.

    Args:
        model: the compiled model, of hinges and slides.
        traces: of the recordings; channels that are not there are left out of every balance.
        most: number of instants to use.
        laws: by actuator, the law that computes its control and the channels that it reads.
    """

    def __init__(
        self, model: mujoco.MjModel, traces: Traces, most: int = 400, laws: Laws | None = None
    ) -> None:
        self.traces = traces
        self.laws = laws or {}
        self.joints = [model.joint(j).name for j in range(model.njnt)]
        self.hinges = {j for j in self.joints if int(model.joint(j).type[0]) == HINGE}
        ids = controlled(model)
        self.actuators = [model.actuator(a).name for a in ids]
        self._reference = np.array(model.qpos0)
        self.carriers = carriers(model)
        step = max(traces.count // most, 1)
        self.rows: Bool[np.ndarray, " n"] = np.arange(traces.count) % step == 0
        self.recorded = set.intersection(*(set(r.channels) for r in traces.recordings))
        self.stated = {n: c.unit for r in traces.recordings for n, c in r.channels.items()}
        self.converted = {
            n for r in traces.recordings for n, c in r.channels.items() if c.converted
        }
        silent = [j for j in self.joints if f"qpos.{j}" not in self.recorded]
        self._late = {
            n: float(model.actuator_delay[a]) for a, n in zip(ids, self.actuators, strict=True)
        }
        self.dynamics = Dynamics(model, silent)  # clears the delays
        self.still = [j for j in silent if j not in self.dynamics.loops.joints]  # taken to be
        known = [n for a, n in zip(ids, self.actuators, strict=True) if follows(model, a)]
        self.inputs = {n for n in map(self._input, known) if n in self.recorded}
        self._lags = {
            n: float(model.actuator_dynprm[a, 0])
            for a, n in zip(ids, self.actuators, strict=True)
            if int(model.actuator_dyntype[a]) in LAGS
        }
        self._driven = {
            self._input(n): driven_joint(model, a) or ""
            for a, n in zip(ids, self.actuators, strict=True)
        }
        self._servo = {
            self._input(n): bool(model.actuator_biasprm[a, 1]) or n in self.laws
            for a, n in zip(ids, self.actuators, strict=True)
        }
        self.motors = {
            self._input(n)
            for a, n in zip(ids, self.actuators, strict=True)
            if n not in self.laws and not model.actuator_biasprm[a, 1:3].any()
        } & {n for n in self.inputs if self._driven[n]}
        self.unknown: dict[str, list[str]] = {}  # by joint, actuators whose force is not told
        self.weights = self._weights(model)
        self._terms: dict[tuple[Wire | None, ...], Terms] = {}
        self._physics: dict[tuple[Wire | None, ...], np.ndarray] = {}

    @cached_property
    def halves(self) -> tuple["WiringEvidence", ...]:
        """The same from each half of the samples; see `Traces.halves`."""
        made = []
        for traces in self.traces.halves:
            half = copy.copy(self)
            half.traces, half._terms, half._physics = traces, {}, {}
            made.append(half)
        return tuple(made)

    def identity(self) -> WiringHypothesis:
        """Return the hypothesis that every channel is what it is called."""
        positions = [f"qpos.{j}" for j in self.joints if f"qpos.{j}" in self.recorded]
        names = [*positions, *sorted(self.inputs)]
        return WiringHypothesis({n: Wire(n) for n in names})

    def scores(
        self, hypothesis: WiringHypothesis, delays: Sequence[float]
    ) -> Float[np.ndarray, " D"]:
        """Return the score of a hypothesis with each of some delays instead of its own."""
        scores = np.log(self.shares(hypothesis, delays) + FLOOR) @ self.weights
        best = delays[int(np.argmin(scores))]
        return np.asarray(scores + self._by_load(hypothesis, best))

    def _by_load(self, hypothesis: WiringHypothesis, delay: float) -> float:
        """Return how much of a score is due to a constant load, which counts for nothing.

        Motion in a unit of a thousandth leaves little of a balance but the load, and new zeros
        balance that whatever the channels are. Such joints count by what varies, if that is worse.
        """
        small = np.array([self._small(hypothesis, joint) for joint in self.joints])
        if not small.any():
            return 0.0
        all_of_it, varying = (self.shares(hypothesis, [delay], varying=v)[0] for v in (False, True))
        worse = np.log((np.maximum(all_of_it, varying) + FLOOR) / (all_of_it + FLOOR))
        return float(worse @ (self.weights * small))

    def _small(self, hypothesis: WiringHypothesis, joint: str) -> bool:
        """Whether a hypothesis has a joint in a smaller unit, and a new zero there as well."""
        wire = hypothesis.wires.get(f"qpos.{joint}")
        if wire is None or wire.scale >= 1.0:
            return False
        commands = [w for n, w in hypothesis.wires.items() if self._driven.get(n) == joint]
        return any(w.offset for w in (wire, *commands))

    def shares(
        self, hypothesis: WiringHypothesis, delays: Sequence[float], *, varying: bool = False
    ) -> Float[np.ndarray, "D nv"]:
        """Return J of each degree of freedom with each of some delays; see `unexplained`."""
        terms = self.terms(hypothesis)
        forces = [terms.actuated(self.controls(hypothesis, d)) for d in delays]
        return unexplained(terms, np.stack(forces), varying=varying)

    def noise(self, hypothesis: WiringHypothesis) -> Float[np.ndarray, " nv"]:
        """Return how much of J is noise in the motion, as two halves of the samples differ.

        A stiff servo of speed gives the small difference of two large terms, of which one is as
        noisy as the speed. Physics that the model lacks is alike in both halves.
        """
        terms, delay = self.terms(hypothesis), hypothesis.delay
        given = terms.actuated(self.controls(hypothesis, delay))
        total = (terms.inertial**2 + terms.rest**2 + given**2).sum(axis=0)
        if not self.halves:
            return np.zeros_like(total)
        one, other = (
            e.terms(hypothesis).required_force
            - e.terms(hypothesis).actuated(e.controls(hypothesis, delay))
            for e in self.halves
        )
        return np.asarray(((one - other) ** 2).sum(axis=0) / (4 * np.maximum(total, 1e-300)))

    def terms(self, hypothesis: WiringHypothesis) -> Terms:
        """Return the balance's terms that follow from the measured channels."""
        wires = self._measured(hypothesis)
        if wires not in self._terms:
            self._terms[wires] = self.dynamics.terms(*(self._motion(wires, k) for k in range(3)))
        return self._terms[wires]

    def opening(self, hypothesis: WiringHypothesis) -> Float[np.ndarray, " _"]:
        """Return how far from closed the model's loops stay at some of the recorded positions."""
        return self.dynamics.opening(self._motion(self._measured(hypothesis), 0)[::_SOME])

    def physics(self, hypothesis: WiringHypothesis) -> Float[np.ndarray, "n nv p"]:
        """Return what may scale without a fault in the wiring.

        The force that each body's mass needs, armature, viscous and dry friction, and a constant.
        """
        wires = self._measured(hypothesis)
        if wires not in self._physics:
            terms = self.terms(hypothesis)
            bodies = self.dynamics.of_bodies(*(self._motion(wires, k) for k in range(3)))
            own = np.stack(
                [terms.acceleration, terms.velocity, terms.dry, np.ones_like(terms.dry)], axis=2
            )
            self._physics[wires] = np.concatenate([bodies, own], axis=2)
        return self._physics[wires]

    def of_points(
        self, hypothesis: WiringHypothesis, body: int, points: Float[np.ndarray, "p 3"]
    ) -> Float[np.ndarray, "n nv p"]:
        """Return what unit masses at points of a body need; see `Dynamics.of_points`."""
        wires = self._measured(hypothesis)
        qpos, qvel, qacc = (self._motion(wires, k) for k in range(3))
        return self.dynamics.of_points(qpos, qvel, qacc, body, points)

    def controls(self, hypothesis: WiringHypothesis, delay: float) -> Float[np.ndarray, "n nu"]:
        """Return what the actuators act on at the instants; see `command`."""
        out = np.zeros((int(self.rows.sum()), len(self.actuators)))
        for k, name in enumerate(self.actuators):
            out[:, k] = self.command(name, hypothesis, delay)
        return out

    def command(
        self, actuator: str, hypothesis: WiringHypothesis, delay: float
    ) -> Float[np.ndarray, " n"]:
        """Return what an actuator acts on at the instants: its control, less its delay and lag.

        Args:
            actuator: its name.
            hypothesis: about the channels.
            delay: of the control's stamps, in [s], beside the actuator's own.
        """
        name = f"ctrl.{actuator}"
        if actuator in self.laws:
            return self._computed(actuator, hypothesis, delay)
        if name not in hypothesis.wires:
            return np.zeros(int(self.rows.sum()))
        late, lag = self._late[actuator], self._lags.get(actuator, 0.0)
        return self.value(hypothesis, name, held=True, delay=delay + late, lag=lag)

    def value(
        self,
        hypothesis: WiringHypothesis,
        name: str,
        *,
        held: bool = False,
        delay: float = 0.0,
        lag: float = 0.0,
    ) -> Float[np.ndarray, " n"]:
        """Return a channel at the instants, as a hypothesis reads it; see `Traces.column`."""
        wire = hypothesis.wires.get(name, Wire(name))
        raw = self.traces.column(wire.source, held=held, delay=delay, lag=lag)[self.rows]
        own = wire.sign * wire.scale * raw + wire.offset
        if wire.less:
            other = replace(hypothesis.wires[wire.less], less="")
            shown = replace(hypothesis, wires={wire.less: other})
            own = own - self.value(shown, wire.less, held=held, delay=delay, lag=lag)
        return np.asarray(own)

    def _computed(
        self, actuator: str, hypothesis: WiringHypothesis, delay: float
    ) -> Float[np.ndarray, " n"]:
        """Return what a law made of the smoothed channels, each instant by itself."""
        law, uses = self.laws[actuator]
        wires, since = self._measured(hypothesis), self._late[actuator]
        qpos, qvel = (self._motion(wires, k, since).T for k in (0, 1))
        zero = np.zeros(qpos.shape[1])
        late = {n: since + delay * (n == f"goal.{actuator}") for n in uses}
        return np.asarray(
            law(
                LawInputs(
                    zero,
                    dict(zip(self.joints, qpos, strict=True)),
                    dict(zip(self.joints, qvel, strict=True)),
                    dict.fromkeys(self.actuators, zero),
                    {n: self.value(hypothesis, n, held=True, delay=late[n]) for n in uses},
                    float(self.dynamics.model.opt.timestep),
                )
            )
        )

    def _input(self, actuator: str) -> str:
        """Return the channel that commands an actuator: its control, or its law's goal."""
        return f"goal.{actuator}" if actuator in self.laws else f"ctrl.{actuator}"

    def driven(self, name: str) -> str:
        """Return the joint that the actuator of a control channel drives; empty where none."""
        return self._driven[name]

    def dof(self, name: str) -> int:
        """Return the degree of freedom that the actuator of a control channel drives."""
        return self.joints.index(self._driven[name])

    def servo(self, name: str) -> bool:
        """Whether the force of a control channel's actuator depends on the joint's position."""
        return self._servo[name]

    def _measured(self, hypothesis: WiringHypothesis) -> tuple[Wire | None, ...]:
        return tuple(hypothesis.wires.get(f"qpos.{j}") for j in self.joints)

    def _motion(self, wires: Sequence[Wire | None], order: int, delay: float = 0.0) -> np.ndarray:
        count = int(self.rows.sum())
        out = np.tile(self._reference * (order == 0), (count, 1))
        for k, wire in enumerate(wires):
            if wire is not None:
                raw = self.traces.column(wire.source, held=False, order=order, delay=delay)
                raw = raw[self.rows]
                out[:, k] = wire.sign * wire.scale * raw + wire.offset * (order == 0)
        shown = out.copy()
        for k, wire in enumerate(wires):
            if wire is not None and wire.less:
                out[:, k] -= shown[:, self.joints.index(wire.less.removeprefix("qpos."))]
        return out

    def _weights(self, model: mujoco.MjModel) -> Float[np.ndarray, " nv"]:
        """Return 1 for degrees of freedom with a balance: recorded, moving, all inputs known."""
        weights = np.zeros(model.nv)
        still = np.zeros((1, model.nv))
        terms = self.dynamics.terms(self._reference[None], still, still)
        felt = (terms.moment * terms.gain[..., None])[0] != 0
        for k, joint in enumerate(self.joints):
            name = f"qpos.{joint}"
            if name not in self.recorded:
                continue
            self.unknown[joint] = [
                a
                for i, a in enumerate(self.actuators)
                if felt[i, k] and a not in self.laws and self._input(a) not in self.inputs
            ]
            moved = any(np.ptp(r.channels[name].values) for r in self.traces.recordings)
            follows = joint in self.dynamics.loops.joints
            weights[k] = float(not self.unknown[joint] and moved and not follows)
        return weights
