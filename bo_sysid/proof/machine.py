"""Machines of a suite: a nominal model, limits, and how it is moved; one small file each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
from jaxtyping import Float
from pydantic import BeforeValidator, ValidationError, model_validator

from bo_sysid.errors import StudyError, nearest
from bo_sysid.mjcf import Address, Model
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.proof.equations import EQUATIONS
from bo_sysid.study.base import Count, Name, NotNegative, Positive, Real, Section
from bo_sysid.study.messages import study_error
from bo_sysid.study.outer import Limit
from bo_sysid.study.sections import ModelSource, ParameterEntry
from bo_sysid.study.source import read

_FADE = 0.5  # [s] in which an excitation grows from nothing
_FILTER = 15.0  # [Hz] corner of the filter behind the velocity that a tracking loop estimates


def _model(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


class Motion(Section):
    """How one actuator is moved: a sum of sines, and around motors a loop that follows one."""

    force: NotNegative = 0.0
    """Amplitude of the sum of sines that is commanded as it is, in the command's unit."""
    goal: NotNegative = 0.0
    """Amplitude of the position that is followed, in rad or m; the command of a servo."""
    centre: Real = 0.0
    """Middle of that position."""
    kp: NotNegative = 0.0
    """Force per position error of the loop around a motor, in N m/rad or N/m."""
    kd: NotNegative = 0.0
    """Force per velocity error of that loop."""
    band: tuple[Positive, Positive] = (0.1, 2.5)
    """Lowest and highest frequency, in Hz."""
    tones: Count = 10
    """Number of sines."""


class MachineFile(Section):
    """A machine as its file describes it."""

    name: Name
    """Name in suites and tables."""
    model: Annotated[ModelSource, BeforeValidator(_model, json_schema_input_type=str | ModelSource)]
    """The nominal model."""
    timestep: Positive = 0.002
    """Time step of the nominal model and of the recordings, in s."""
    equations: Name | None = None
    """Equations of motion for plants that are not MuJoCo."""
    contact: bool = False
    """Whether contact decides how it moves; sizes are then taken over short windows."""
    limits: Mapping[str, Limit]
    """By the joint's name, bounds of every excitation."""
    move: Mapping[str, Motion]
    """By the actuator's name, how it is moved."""
    parameters: tuple[ParameterEntry, ...] = ()
    """What may be wrong but is modelled, where a suite asks for it."""

    @model_validator(mode="after")
    def _tied(self) -> "MachineFile":
        if any(p.each for p in self.parameters):
            raise ValueError("parameters: one value each; list the addresses apart")
        return self


@dataclass(frozen=True)
class ProofMachine:
    """A machine that cases are drawn from.

    Attributes:
        file: what its file says.
        model: the nominal model, at the machine's time step.
        compiled: the nominal model, compiled.
    """

    file: MachineFile
    model: Model
    compiled: mujoco.MjModel

    @property
    def name(self) -> str:
        """Name in suites and tables."""
        return self.file.name

    @property
    def tiers(self) -> tuple[int, ...]:
        """Tiers for which the machine has a plant."""
        return (2, 3, 4) if self.file.equations else (2, 4)

    def joint(self, dof: int) -> str:
        """Return the name of the joint of a degree of freedom."""
        return str(self.compiled.joint(int(self.compiled.dof_jntid[dof])).name)

    def dof(self, joint: str) -> int:
        """Return the degree of freedom of a joint."""
        return int(self.compiled.joint(joint).dofadr[0])

    def actuator_on(self, joint: str) -> int | None:
        """Return the actuator that drives a joint, None where there is none."""
        m, j = self.compiled, self.compiled.joint(joint).id
        found = [a for a in range(m.nu) if int(m.actuator_trnid[a, 0]) == j]
        return found[0] if found else None

    def bodies_of_masses(self, addresses: Sequence[str]) -> frozenset[str]:
        """Return the bodies whose mass stands at one of some addresses."""
        each = [e for a in addresses for e in Address.parse(a).matches(self.model)]
        masses = [a for a in map(Address.parse, each) if (a.kind, a.attribute) == ("geom", "mass")]
        bodies = [int(self.compiled.geom(a.pattern).bodyid[0]) for a in masses]
        return frozenset(str(self.compiled.body(b).name) for b in bodies)


def load_machine(path: Path) -> ProofMachine:
    """Read a machine's file and its nominal model.

    Raises:
        StudyError: the file is wrong.
        ModelError: the model is missing or does not compile.
    """
    source = read(path, {})
    try:
        file = MachineFile.model_validate(source.data)
    except ValidationError as error:
        raise study_error(error, source, MachineFile) from None
    if file.equations is not None and file.equations not in EQUATIONS:
        raise source.error(
            ("equations",), f"unknown {file.equations!r}; {nearest(file.equations, EQUATIONS)}"
        )
    model = _nominal(file, path)
    compiled = model.compile()
    if set(compiled.jnt_type.tolist()) - set(SCALAR):
        raise source.error(("model",), "machines of the proof have hinges and slides only")
    for key, known in (("limits", model.joints), ("move", model.actuators)):
        for name in getattr(file, key):
            if name not in known:
                raise source.error((key, name), f"not in the model; {nearest(name, known)}")
    still = set(model.actuators) - set(file.move)
    if still:
        raise source.error(("move",), f"does not say how {sorted(still)[0]!r} is moved")
    return ProofMachine(file, model, compiled)


def _nominal(file: MachineFile, path: Path) -> Model:
    source = file.model
    if source.file is not None:
        where = path.parent / source.file
        if not where.is_file():
            raise StudyError(f"{path}: model: no such file {where}")
        spec = Model.from_file(where).spec()
    elif source.dm_control is not None:
        spec = Model.from_dm_control(source.dm_control.domain, source.dm_control.task).spec()
    else:
        raise StudyError(f"{path}: model: a file or a dm_control task")
    spec.option.timestep = file.timestep
    return Model(file.name, str(path), spec)


class MotionCommand:
    """Commands that move a machine within its limits; a `Command` of the plants.

    A motor gets the sum of sines and, around it, a loop that follows another sum of sines, so that
    joints without gravity do not drift away; the velocity it needs is a filtered difference of
    what the encoder says. What is commanded is what is recorded.

    Args:
        machine: to be moved.
        seconds: length of the recording.
        rng: of frequencies and phases.
        noise: `T x n` noise of the encoders, which the loop sees.
        quantum: step of the encoders; 0 where they are not rounded.
        amplitude: share of the amplitudes in the machine's file.
    """

    def __init__(
        self,
        machine: ProofMachine,
        seconds: float,
        rng: np.random.Generator,
        noise: Float[np.ndarray, "T n"],
        quantum: float = 0.0,
        amplitude: float = 1.0,
    ) -> None:
        m, dt = machine.compiled, machine.file.timestep
        time = np.arange(round(seconds / dt)) * dt
        self._noise, self._quantum, self._dt = noise, quantum, dt
        self._dofs = [int(m.jnt_dofadr[m.actuator_trnid[a, 0]]) for a in range(m.nu)]
        self._scale = [float(m.actuator_gear[a, 0] * m.actuator_gainprm[a, 0]) for a in range(m.nu)]
        self._moves = [machine.file.move[m.actuator(a).name] for a in range(m.nu)]
        self._servo = [m.actuator_biasprm[a, 1] != 0 for a in range(m.nu)]
        self._most = [_effort(machine, a) for a in range(m.nu)]
        self._sines = np.stack([_sines(k, time, rng) for k in self._moves], axis=1)
        goals = np.stack([_sines(k, time, rng) for k in self._moves], axis=1)
        size = np.array([k.goal for k in self._moves]) * amplitude
        self._goals = np.array([k.centre for k in self._moves]) + goals * size
        self._speeds = np.gradient(self._goals, dt, axis=0)
        self._sines *= np.array([k.force for k in self._moves]) * amplitude
        self._last: list[float] | None = None
        self._velocity = [0.0] * m.nv
        self._rate = 1.0 - float(np.exp(-2 * np.pi * _FILTER * dt))

    def __call__(self, k: int, measured: Sequence[float]) -> list[float]:
        """Return the commands from row k on."""
        seen = rounded(np.asarray(measured) + self._noise[k], self._quantum).tolist()
        if self._last is not None:
            for j, (new, old) in enumerate(zip(seen, self._last, strict=True)):
                self._velocity[j] += self._rate * ((new - old) / self._dt - self._velocity[j])
        self._last = seen
        return [self._one(a, k, seen) for a in range(len(self._moves))]

    def _one(self, a: int, k: int, seen: Sequence[float]) -> float:
        move, j = self._moves[a], self._dofs[a]
        if self._servo[a]:
            return float(self._goals[k, a])
        force = move.kp * (self._goals[k, a] - seen[j])
        force += move.kd * (self._speeds[k, a] - self._velocity[j])
        u = float(self._sines[k, a] + force / self._scale[a])
        return min(max(u, -self._most[a]), self._most[a])


def _effort(machine: ProofMachine, a: int) -> float:
    """Return the largest command of a motor: what effort and control range allow."""
    m = machine.compiled
    limit = machine.file.limits.get(machine.joint(int(m.jnt_dofadr[m.actuator_trnid[a, 0]])))
    scale = abs(float(m.actuator_gear[a, 0] * m.actuator_gainprm[a, 0]))
    most = float("inf") if limit is None or limit.effort is None else limit.effort / scale
    control = int(m.actuator_ctrladr[a])
    if m.actuator_ctrllimited[control]:
        most = min(most, float(np.abs(m.actuator_ctrlrange[control]).min()))
    return most


def _sines(move: Motion, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a sum of sines of random phase with crest 1, which grows from nothing."""
    edges = np.geomspace(*move.band, move.tones + 1)
    frequency = rng.uniform(edges[:-1], edges[1:])
    phase = rng.uniform(0, 2 * np.pi, move.tones)
    s = np.sin(2 * np.pi * frequency[:, None] * time + phase[:, None])
    s = (s / np.sqrt(frequency[:, None] / move.band[0])).sum(axis=0)
    return np.asarray(s / np.abs(s).max() * np.minimum(time / _FADE, 1.0))


def rounded(values: np.ndarray, quantum: float) -> np.ndarray:
    """Return what an encoder of finite resolution shows."""
    return np.asarray(values if quantum == 0 else np.round(values / quantum) * quantum)
