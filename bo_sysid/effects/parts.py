"""Parts of an effect that MJCF cannot express, simulated beside the model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float

from bo_sysid.recording import Channel

Signal: TypeAlias = Float[np.ndarray, "..."]


@runtime_checkable
class Motion(Protocol):
    """What a force law may look at, for many simulations at one instant.

    Attributes:
        time: time since the start of the window in [s].
        qpos: position of each hinge or slide joint by name in [rad] or [m].
        qvel: velocity of each hinge or slide joint by name in [rad/s] or [m/s].
        ctrl: control of each actuator by name.
        act: activation, by name, of each actuator whose force lags behind its control.
        signals: recorded inputs by channel name (``goal.elbow``, ``aux.voltage``).
        timestep: time until the next evaluation in [s].
        memory: of the law's own, empty when a simulation starts.
    """

    @property
    def time(self) -> Signal: ...  # noqa: D102
    @property
    def qpos(self) -> Mapping[str, Signal]: ...  # noqa: D102
    @property
    def qvel(self) -> Mapping[str, Signal]: ...  # noqa: D102
    @property
    def ctrl(self) -> Mapping[str, Signal]: ...  # noqa: D102
    @property
    def act(self) -> Mapping[str, Signal]: ...  # noqa: D102
    @property
    def signals(self) -> Mapping[str, Signal]: ...  # noqa: D102
    @property
    def timestep(self) -> float: ...  # noqa: D102
    @property
    def memory(self) -> dict[str, object]: ...  # noqa: D102


@dataclass(frozen=True)
class Force:
    """A force on one joint as a function of the motion, in [N m] or [N].

    Attributes:
        joint: name of the joint.
        law: the force for each of many simulations.
        hold: time in [s] for which a value may be held; 0 where it follows every step.
    """

    joint: str
    law: Callable[[Motion], Signal]
    hold: float = 0.0


@dataclass(frozen=True)
class Filter:
    """A change of one actuator's whole recorded control, made before windows are cut.

    Attributes:
        actuator: name of the actuator.
        change: from the channel and the simulation's time step to the changed channel.
    """

    actuator: str
    change: Callable[[Channel, float], Channel]


@dataclass(frozen=True)
class Reading:
    """What a channel shows of the quantity p(t) it measures: (1 + scale)·p(t - delay) + offset.

    Attributes:
        channel: name of the channel.
        scale: relative.
        offset: in the channel's unit.
        delay: in [s].
        source: the channel whose quantity it measures instead of its own, where swapped.
        encoder: whether it is the joint's encoder that reads so, by which a servo goes as well.
    """

    channel: str
    scale: float = 0.0
    offset: float = 0.0
    delay: float = 0.0
    source: str | None = None
    encoder: bool = False


@dataclass(frozen=True)
class Hidden:
    """A joint that an effect added: a coordinate beyond the recorded ones.

    Attributes:
        joint: its name in the edited model.
        of: the joint whose axis it shares.
        shown: how much of it the encoder of `of` shows: 0 on the motor's side, 1 on the link's.
        under: from the torque that the motor's side hands to the link, in [N m] or [N], to where
            the joint comes to rest under it, in [rad] or [m]; a simulation begins there.
        most: how far from zero it can be, in [rad] or [m].
    """

    joint: str
    of: str
    shown: float = 0.0
    under: Callable[[Signal], Signal] = np.zeros_like
    most: float = np.inf


Part: TypeAlias = Force | Filter | Reading | Hidden
