"""The controls that laws write, along what was recorded: they give the scales of the actuators."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from bo_sysid.mjcf.commands import controlled, lags
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Controller, ForceLaw, LawInputs


def driven(
    model: mujoco.MjModel, recordings: Sequence[Recording], laws: Sequence[Controller | ForceLaw]
) -> tuple[Recording, ...]:
    """Return the recordings with the control of every controller beside what was recorded.

    A law with memory sees each instant as the first one, joints that were not recorded at rest
    where the model puts them, and a lag as settled at its control; the result gives scales and
    enters no prediction.

    Args:
        model: the compiled nominal model.
        recordings: what was recorded.
        laws: of the nominal model.
    """
    own = [w for w in laws if isinstance(w, Controller)]
    return tuple(_one(model, r, own) for r in recordings) if own else tuple(recordings)


def _one(model: mujoco.MjModel, recording: Recording, laws: Sequence[Controller]) -> Recording:
    positions = recording.of_kind("qpos")
    if not positions:
        return recording
    time = next(iter(positions.values())).time
    scalar = [model.joint(j) for j in range(model.njnt) if int(model.jnt_type[j]) in SCALAR]
    qpos = {j.name: np.full(time.size, j.qpos0[0]) for j in scalar}
    qpos |= {n: np.interp(time, c.time, c.values) for n, c in positions.items()}
    qvel = {n: np.gradient(q, time) for n, q in qpos.items()}
    held = {n: c.at(time) for n, c in recording.channels.items() if c.continuous}
    ctrl = {model.actuator(a).name: np.zeros(time.size) for a in controlled(model)}
    ctrl |= {n.removeprefix("ctrl."): v for n, v in held.items() if n.startswith("ctrl.")}
    lagging = [model.actuator(a).name for a in controlled(model) if lags(model, a)]
    step = float(np.median(np.diff(time)))
    made: dict[str, Channel] = {}
    for law in laws:
        act = {n: held.get(f"act.{n}", ctrl[n]) for n in lagging}
        inputs = LawInputs(time - time[0], qpos, qvel, dict(ctrl), held, step, act=act)
        ctrl[law.actuator] = np.broadcast_to(np.asarray(law.law(inputs), float), time.shape)
        name = f"ctrl.{law.actuator}"
        made[name] = Channel(time, ctrl[law.actuator], "", f"{recording.name}: {name}", "zero")
    return replace(recording, channels={**recording.channels, **made})
