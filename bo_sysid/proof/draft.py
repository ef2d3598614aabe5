"""Composing a plant: its nominal physics, and what is concealed in it, one change after another."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects import at_slide
from bo_sysid.errors import StudyError, nearest
from bo_sysid.mjcf.joints import HINGE
from bo_sysid.proof.bodies import copy_model
from bo_sysid.proof.machine import ProofMachine
from bo_sysid.proof.physics import (
    Bristle,
    Concealed,
    Drive,
    Encoder,
    Law,
    Physics,
    Transmission,
    nominal_physics,
)
from bo_sysid.proof.rolled import Rolled


@dataclass(frozen=True)
class Scales:
    """How a machine moves when nothing is concealed: what magnitudes are begun from.

    Attributes:
        force: typical force along each degree of freedom.
        speed: root mean square of each velocity.
        travel: standard deviation of each position.
        centre: mean of each position.
        span: range of each position.
        inertia: typical inertia of each degree of freedom.
        command: standard deviation of each command.
        effort: largest force of each actuator along its joint.
    """

    force: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    travel: Float[np.ndarray, " n"]
    centre: Float[np.ndarray, " n"]
    span: Float[np.ndarray, " n"]
    inertia: Float[np.ndarray, " n"]
    command: Float[np.ndarray, " m"]
    effort: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, physics: Physics, rolled: Rolled) -> "Scales":
        """Measure them on a trajectory of the nominal plant."""
        q, v = rolled.qpos, rolled.qvel
        dt = float(rolled.time[1] - rolled.time[0])
        inertia = _inertia(physics.model, q)
        moved = inertia * np.gradient(v, dt, axis=0).std(axis=0)
        forces = [drive_force(d, rolled, a) for a, d in enumerate(physics.drives)]
        for drive, force in zip(physics.drives, forces, strict=True):
            moved[drive.dof] = max(moved[drive.dof], 0.3 * force.std())
        return cls(
            moved,
            np.sqrt(np.mean(v**2, axis=0)),
            q.std(axis=0),
            q.mean(axis=0),
            np.ptp(q, axis=0),
            inertia,
            rolled.ctrl.std(axis=0),
            np.array([np.abs(f).max() for f in forces]),
        )


def drive_force(drive: Drive, rolled: Rolled, a: int) -> Float[np.ndarray, " T"]:
    """Return what actuator `a` would do along its joint without limit, lag, delay and dead zone."""
    b0, b1, b2 = drive.bias
    q, v = rolled.qpos[:, drive.dof], rolled.qvel[:, drive.dof]
    force = drive.gain * rolled.ctrl[:, a] + b0 + drive.gear * (b1 * q + b2 * v)
    return np.asarray(drive.gear * force)


def _inertia(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    """Return the median of 1/diag(M⁻¹) over poses."""
    data, full, found = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    for pose in q[:: max(len(q) // 20, 1)]:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        found.append(1.0 / np.diag(np.linalg.inv(full)))
    return np.asarray(np.median(found, axis=0))


@dataclass(frozen=True)
class Place:
    """Where something is concealed.

    Attributes:
        machine: the machine.
        scales: how it moves.
        site: name of the site.
    """

    machine: ProofMachine
    scales: Scales
    site: str

    @property
    def dof(self) -> int:
        """Degree of freedom of the site, a joint or (a channel) its position."""
        return self.machine.dof(self.site.removeprefix("qpos."))

    @property
    def actuator(self) -> int:
        """Number of the site, an actuator."""
        return int(self.machine.compiled.actuator(self.site).id)

    def unit(self, unit: str, dof: int | None = None) -> str:
        """Return a hinge's unit as it reads at the joint of a degree of freedom."""
        m = self.machine.compiled
        kind = int(m.jnt_type[m.dof_jntid[self.dof if dof is None else dof]])
        return unit if kind == HINGE else at_slide(unit)


@dataclass
class Draft:
    """A plant while it is composed; `finished` returns it."""

    machine: ProofMachine
    model: mujoco.MjModel
    drives: list[Drive]
    encoders: list[Encoder]
    laws: list[Law] = field(default_factory=list)
    bristles: list[Bristle] = field(default_factory=list)
    transmission: Transmission | None = None

    @classmethod
    def begin(cls, machine: ProofMachine, model: mujoco.MjModel) -> "Draft":
        """Begin with a plant that conceals nothing."""
        plain = nominal_physics(model)
        return cls(machine, copy_model(model), list(plain.drives), list(plain.encoders))

    def change_drive(self, a: int, **changes: object) -> None:
        """Change a drive."""
        self.drives[a] = replace(self.drives[a], **changes)  # type: ignore[arg-type]

    def change_encoder(self, dof: int, **changes: object) -> None:
        """Change an encoder."""
        self.encoders[dof] = replace(self.encoders[dof], **changes)  # type: ignore[arg-type]

    def finished(self) -> Physics:
        """Return the plant."""
        return Physics(
            self.model,
            tuple(self.drives),
            tuple(self.encoders),
            tuple(self.laws),
            tuple(self.bristles),
            self.transmission,
        )


@dataclass(frozen=True)
class Realised:
    """A kind of physics that the proof can conceal.

    Attributes:
        id: in the catalogue, or a name of its own.
        sites: names of the sites of a machine where it can be.
        draw: from a generator and a place to a first magnitude with random details; its size is
            set afterwards.
        compose: puts it into a draft.
        most: largest absolute value, at a place.
        along: details that grow with the value.
        tiers: for which it is drawn.
        known: whether the catalogue has it.
    """

    id: str
    sites: Callable[[ProofMachine], tuple[str, ...]]
    draw: Callable[[np.random.Generator, Place], Concealed]
    compose: Callable[[Draft, Concealed], None]
    most: Callable[[Place], float] = lambda place: float("inf")
    along: tuple[str, ...] = ()
    tiers: tuple[int, ...] = (2, 3)
    known: bool = True

    def scaled(self, concealed: Concealed, factor: float) -> Concealed:
        """Return the same at another magnitude."""
        details = {k: v * factor if k in self.along else v for k, v in concealed.details.items()}
        return replace(concealed, value=concealed.value * factor, details=details)


_REALISED: dict[str, Realised] = {}

REALISED: Mapping[str, Realised] = MappingProxyType(_REALISED)
"""Physics that can be concealed, by id."""


def realised(item: Realised) -> None:
    """Register what can be concealed."""
    if item.id in _REALISED:
        raise StudyError(f"{item.id!r} is registered twice")
    _REALISED[item.id] = item


def find_realised(id: str) -> Realised:
    """Return what can be concealed by its id.

    Raises:
        StudyError: the proof has no such physics.
    """
    if id not in _REALISED:
        raise StudyError(f"nothing called {id!r} can be concealed; {nearest(id, _REALISED)}")
    return _REALISED[id]
