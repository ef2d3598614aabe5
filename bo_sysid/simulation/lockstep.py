"""Laws that are stepped together with the simulation: controllers and forces.

MuJoCo's batch runs without Python callbacks, so a law is evaluated for all windows at once between
two steps: a controller writes `ctrl`, a force law adds to `qfrc_applied`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.effects.parts import Force, Part
from bo_sysid.mjcf.commands import controlled, lags
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.simulation.delays import delayed_commands

Signal = Float[np.ndarray, " W"]
Rows = slice | Int[np.ndarray, " r"]

_ALL = slice(None)


@dataclass(frozen=True)
class LawInputs:
    """What a law may look at, for W simulations at one instant.

    Attributes:
        time: `W` time since the start of the window in [s].
        qpos: position of each hinge or slide joint by name, `W`, in [rad] or [m].
        qvel: velocity of each hinge or slide joint by name, `W`, in [rad/s] or [m/s].
        ctrl: control of each actuator by name, `W`, as recorded or as written by earlier laws.
        signals: recorded inputs by channel name (``goal.elbow``, ``aux.voltage``), `W`.
        timestep: time until the next evaluation in [s].
        memory: a dictionary of the law's own, empty at the start of every roll-out; a law with
            history keeps its arrays here.
        act: of each actuator whose force lags behind its control the activation, of each delayed
            one the control that it acts on now, by name, `W`.
    """

    time: Signal
    qpos: Mapping[str, Signal]
    qvel: Mapping[str, Signal]
    ctrl: Mapping[str, Signal]
    signals: Mapping[str, Signal]
    timestep: float
    memory: dict[str, Any] = field(default_factory=dict)
    act: Mapping[str, Signal] = field(default_factory=dict)


Law = Callable[[LawInputs], Signal]


@dataclass(frozen=True)
class Controller:
    """A law that gives the control of one actuator.

    Attributes:
        actuator: name of the actuator.
        law: returns its control for each of W simulations, in the actuator's unit.
    """

    actuator: str
    law: Law


@dataclass(frozen=True)
class ForceLaw:
    """A law that adds a force to one degree of freedom.

    Attributes:
        joint: name of a hinge or slide joint.
        law: returns the force on each of W simulations in [N m] or [N].
        hold: time in [s] for which a value may be held; 0 where it follows every step.
    """

    joint: str
    law: Law
    hold: float = 0.0


def force_laws(parts: Sequence[Part]) -> tuple[ForceLaw, ...]:
    """Return the forces among `parts` as laws of the simulation."""
    return tuple(ForceLaw(p.joint, p.law, p.hold) for p in parts if isinstance(p, Force))


def live_arrays(model: mujoco.MjModel, bind: Callable[[str], np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a batch that laws read and write.

    Args:
        model: the compiled model.
        bind: returns the live array of a name, one row for each simulation.
    """
    names = ["qpos", "qvel", "ctrl", "qfrc_applied"]
    names += [n for n, size in (("act", model.na), ("history", model.nhistory)) if size]
    return {n: bind(n) for n in names}


def steps_held(laws: Sequence[Controller | ForceLaw], timestep: float) -> int:
    """Return over how many steps all laws may hold what they returned, at least one."""
    holds = [w.hold if isinstance(w, ForceLaw) else 0.0 for w in laws]
    return max(round(min(holds, default=0.0) / timestep), 1)


class LockStep:
    """Evaluates laws on the live arrays of a batch; one for each roll-out."""

    def __init__(
        self,
        model: mujoco.MjModel,
        laws: tuple[Controller | ForceLaw, ...],
        signals: Mapping[str, Float[np.ndarray, "W S"]],
        views: Mapping[str, np.ndarray],
        force: Float[np.ndarray, "W S nv"] | None,
        every: int = 1,
    ) -> None:
        """Bind laws to a batch.

        Args:
            model: the compiled model.
            laws: in the order in which they act.
            signals: recorded inputs by channel name.
            views: see `live_arrays`; without act or history nothing lags, or is delayed.
            force: generalised forces that act beside the laws.
            every: steps from one evaluation to the next.
        """
        self._model, self._laws = model, laws
        self._signals = signals
        self._views = views
        self._force = force
        self._timestep, self._every = float(model.opt.timestep), every
        scalar = [j for j in range(model.njnt) if int(model.jnt_type[j]) in SCALAR]
        names = [model.joint(j).name for j in scalar]
        self._dof = {n: int(model.jnt_dofadr[j]) for n, j in zip(names, scalar, strict=True)}
        self._qpos = {
            n: views["qpos"][:, int(model.jnt_qposadr[j])]
            for n, j in zip(names, scalar, strict=True)
        }
        self._qvel = {n: views["qvel"][:, k] for n, k in self._dof.items()}
        self._actuator = {model.actuator(a).name: i for i, a in enumerate(controlled(model))}
        self._ctrl = {n: views["ctrl"][:, i] for n, i in self._actuator.items()}
        self._act = {
            n: views["act"][:, int(model.actuator_actadr[a])]
            for a, n in zip(controlled(model), self._actuator, strict=True)
            if "act" in views and lags(model, a)
        }
        self._memories: list[dict[str, Any]] = [{} for _ in laws]

    def apply(self, step: int, column: int | None = None) -> None:
        """Evaluate every law at the state before simulation step `step`.

        Args:
            step: since the roll-out began.
            column: of the signals and forces at that step; by default the step's number.
        """
        k = step if column is None else column
        applied = self._views["qfrc_applied"]
        applied[:] = 0.0 if self._force is None else self._force[:, k]
        signals = {name: values[:, k] for name, values in self._signals.items()}
        time, acting = np.full(len(applied), step * self._timestep), self._acting()
        for law, memory in zip(self._laws, self._memories, strict=True):
            self._evaluate(law, _ALL, time, signals, acting, memory)

    def apply_to(
        self, rows: Int[np.ndarray, " r"], time: Signal, *, forget: Bool[np.ndarray, " r"]
    ) -> None:
        """Evaluate every law in some simulations, which need not have begun together.

        Nothing changes in the others. There are no recorded inputs.

        Args:
            rows: numbers of the simulations.
            time: `r`, of each since its window or episode began, in [s].
            forget: those that begin, of which the laws remember nothing.
        """
        count, acting = len(self._views["qfrc_applied"]), self._acting()
        self._views["qfrc_applied"][rows] = 0.0
        for some, begun in ((forget, False), (~forget, True)):
            if not some.any():
                continue
            at = _ALL if np.count_nonzero(some) == count else rows[some]
            for law, memory in zip(self._laws, self._memories, strict=True):
                own = {k: _taken(x, at, count) for k, x in memory.items()} if begun else {}
                self._evaluate(law, at, time[some], {}, acting, own)
                memory.update({k: _put(x, at, memory.get(k), count) for k, x in own.items()})

    def remembered(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that laws keep."""
        return {
            f"{i} {name}": np.array(value)
            for i, memory in enumerate(self._memories)
            for name, value in memory.items()
        }

    def remember(self, kept: Mapping[str, np.ndarray]) -> None:
        """Give laws the arrays that `remembered` returned."""
        self._memories = [{} for _ in self._laws]
        for key, value in kept.items():
            number, name = key.split(" ", 1)
            self._memories[int(number)][name] = np.array(value)

    def _acting(self) -> dict[str, Signal]:
        """Return what actuators act on that do not follow their controls at once."""
        if "history" not in self._views:
            return self._act
        return self._act | delayed_commands(self._model, self._views["history"])

    def _evaluate(
        self,
        law: Controller | ForceLaw,
        at: Rows,
        time: Signal,
        signals: Mapping[str, Signal],
        acting: Mapping[str, Signal],
        memory: dict[str, Any],
    ) -> None:
        qpos, qvel, ctrl, act = (
            group if at is _ALL else {name: x[at] for name, x in group.items()}
            for group in (self._qpos, self._qvel, self._ctrl, acting)
        )
        until_next = self._every * self._timestep
        value = law.law(LawInputs(time, qpos, qvel, ctrl, signals, until_next, memory, act))
        if isinstance(law, Controller):
            self._views["ctrl"][at, self._actuator[law.actuator]] = value
        else:
            self._views["qfrc_applied"][at, self._dof[law.joint]] += value


def _taken(value: Any, at: Rows, count: int) -> Any:
    """Return the rows of what a law keeps; what is not an array over all simulations is shared."""
    return value[at] if np.shape(value)[:1] == (count,) else value


def _put(value: Any, at: Rows, kept: Any, count: int) -> Any:
    """Return what a law keeps of all simulations, those of `at` replaced."""
    if isinstance(at, slice) or np.shape(value)[:1] != at.shape:
        return value
    value = np.asarray(value)
    whole = np.zeros((count, *value.shape[1:]), value.dtype) if kept is None else np.array(kept)
    whole[at] = value
    return whole
