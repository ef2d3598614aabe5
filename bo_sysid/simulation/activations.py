"""Activations at the start of a window: what actuators with memory made of the controls before."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Ctrl
from bo_sysid.effects.balance import balances
from bo_sysid.effects.driven import driven, is_driven
from bo_sysid.effects.memory import activation, forgets_after, remembers
from bo_sysid.mjcf import Model, ParameterLike
from bo_sysid.mjcf.address import resolve
from bo_sysid.mjcf.commands import controlled
from bo_sysid.recording import Recording
from bo_sysid.simulation.windows import Windows


def activations(
    model: Model,
    compiled: mujoco.MjModel,
    recording: Recording,
    start: Float[np.ndarray, " W"],
    ctrl: Ctrl,
) -> Float[np.ndarray, "W na"]:
    """Return the activations at some times: recorded, or what the recorded controls led to.

    A lag begins in the steady state of its first control, an integrator that holds a position where
    its forces balance (`effects.memory`). Muscles, motors with states of their own and PIDs follow
    the recorded motion (`effects.driven`). Any other activation is in the steady state of its
    control.

    Args:
        model: names the channels.
        compiled: the same model.
        recording: what was recorded.
        start: `W` times in [s].
        ctrl: `W x S x nu` controls from there on.
    """
    act, along = np.zeros((len(start), compiled.na)), None
    for k, a in enumerate(controlled(compiled)):
        address, count = int(compiled.actuator_actadr[a]), int(compiled.actuator_actnum[a])
        if address < 0:
            continue
        control = model.ctrl_channels[k]
        name = control.replace("ctrl.", "act.", 1)
        own = slice(address, address + count)
        if count == 1 and name in recording.channels:
            act[:, own] = recording.channels[name].at(start)[:, None]
        elif control not in recording.channels:
            continue
        elif remembers(compiled, a):
            act[:, address] = activation(compiled, recording, a, start)
        elif is_driven(compiled, a):
            along = driven(compiled, recording, start) if along is None else along
            act[:, own] = along[:, own]
        else:
            act[:, own] = ctrl[:, 0, k][:, None]
    return act


def memory_of(model: Model, compiled: mujoco.MjModel, recording: Recording) -> Mapping[str, float]:
    """Return for how long in [s] what was sent before a recording acts, by channel of the control.

    Where an activation was recorded, nothing before it is needed but what a delay holds back.
    """
    found = {}
    for k, a in enumerate(controlled(compiled)):
        control = model.ctrl_channels[k]
        if control.replace("ctrl.", "act.", 1) in recording.channels:
            found[control] = float(compiled.actuator_delay[a])
        else:
            found[control] = forgets_after(compiled, a)
    return {n: seconds for n, seconds in found.items() if seconds > 0}


def activations_of(
    model: Model,
    compiled: mujoco.MjModel,
    recordings: Sequence[Recording],
    windows: Windows,
    ctrl: Ctrl,
) -> Float[np.ndarray, "W na"]:
    """Return the activations with which windows of several recordings begin.

    Args:
        model: names the channels.
        compiled: the same model, or with edits in it.
        recordings: of which the windows were cut, with the controls of the actuators.
        windows: W windows.
        ctrl: their `W x S x nu` controls.
    """
    act = np.zeros((len(windows), compiled.na))
    for i, recording in enumerate(recordings):
        own = windows.recording == i
        if not own.any():
            continue
        act[own] = activations(model, compiled, recording, windows.time[own], ctrl[own])
    return act


def set_activations(model: Model, parameters: Sequence[ParameterLike]) -> bool:
    """Whether parameters set what activations follow from.

    That is time constants and delays, and all of a model for a servo that balances what it carries.
    """
    compiled = model.compile()
    if parameters and any(balances(compiled, a) for a in controlled(compiled)):
        return True
    targets = [t for p in parameters for address in p.addresses for t in resolve(model, address)]
    return any(t.kind == "actuator" and t.name in ("dynprm", "delay") for t in targets)
