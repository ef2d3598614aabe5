"""What actuators were told under a hypothesis, and whether their activations differ by it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects import Filter, Part
from bo_sysid.effects.balance import balances
from bo_sysid.effects.beside import as_commanded_and_measured
from bo_sysid.effects.driven import is_driven
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.commands import controlled
from bo_sysid.mjcf.compiling import differ
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import control_steps
from bo_sysid.simulation import State
from bo_sysid.simulation.cutting import controls
from bo_sysid.simulation.delays import remembered_steps
from bo_sysid.simulation.windows import Windows


def commanded(
    recordings: Sequence[Recording], parts: Sequence[Part], timestep: float
) -> tuple[Recording, ...]:
    """Return recordings with the controls that the filters among `parts` make of them.

    Args:
        recordings: as the machine told them.
        parts: of a hypothesis; what is no filter is left alone.
        timestep: of the simulation in [s].
    """
    filters = [p for p in parts if isinstance(p, Filter)]
    return tuple(as_commanded_and_measured(r, filters, timestep) for r in recordings)


@dataclass(frozen=True)
class Told:
    """What the actuators of a model were told.

    Attributes:
        model: the nominal model.
        compiled: the same, compiled.
        recordings: as the machine told them.
        with_law: actuators whose control a law of the study computes.
    """

    model: Model
    compiled: mujoco.MjModel
    recordings: tuple[Recording, ...]
    with_law: Sequence[str]

    def filtered(
        self,
        parts: Sequence[Part],
        windows: Windows,
        recorded: Float[np.ndarray, "W S nu"],
        start: Float[np.ndarray, " W"],
    ) -> Float[np.ndarray, "W S nu"]:
        """Return controls of S steps from `start` [s] on after the filters among `parts`."""
        filtered = dict.fromkeys(p.actuator for p in parts if isinstance(p, Filter))
        if not filtered:
            return recorded
        ctrl, dt = recorded.copy(), windows.timestep
        for i, recording in enumerate(commanded(self.recordings, parts, dt)):
            own = windows.recording == i
            for actuator in filtered:
                column = self.model.ctrl_channels.index(f"ctrl.{actuator}")
                channel = recording.channels[f"ctrl.{actuator}"]
                ctrl[own, :, column] = control_steps(channel, start[own], ctrl.shape[1], dt)
        return ctrl

    def remembered(
        self, model: mujoco.MjModel, parts: Sequence[Part], windows: Windows, start: State
    ) -> State:
        """Return starts that remember the controls before them at the windows' time step."""
        past, late = windows.start.past, remembered_steps(model)
        if not late:
            return start
        if past is None or past.shape[1] < late:  # parameters may have a longer delay
            past = self._before(windows, late)
        before = windows.time - past.shape[1] * windows.timestep
        return replace(start, past=self.filtered(parts, windows, past, before))

    def _before(self, windows: Windows, steps: int) -> Float[np.ndarray, "W D nu"]:
        """Return the recorded controls of the last steps before each window."""
        dt, start = windows.timestep, windows.time - steps * windows.timestep
        past = np.zeros((len(windows), steps, windows.ctrl.shape[2]))
        for i, recording in enumerate(self.recordings):
            own = windows.recording == i
            past[own] = controls(
                self.model, self.compiled, recording, start[own], steps, dt, self.with_law
            )
        return past


def changed_activations(
    nominal: mujoco.MjModel, model: mujoco.MjModel, parts: Sequence[Part]
) -> bool:
    """Whether an activation differs by its control's filters, its own numbers or what it balances.

    Args:
        nominal: for which windows were cut.
        model: of a hypothesis.
        parts: of the hypothesis.
    """
    filtered = {p.actuator for p in parts if isinstance(p, Filter)}
    remembering = [a for a in controlled(nominal) if nominal.actuator_actnum[a]]
    if any(balances(nominal, a) for a in remembering) and differ(nominal, model):
        return True
    for a in remembering:
        name = nominal.actuator(a).name
        own, other = (_numbers(m, m.actuator(name).id) for m in (nominal, model))
        if name in filtered or own != other:
            return True
    return False


def _numbers(model: mujoco.MjModel, a: int) -> tuple[float, ...]:
    """Return the numbers of an actuator that its activations follow from."""
    own = (*model.actuator_dynprm[a], model.actuator_delay[a])
    if not is_driven(model, a):
        return own
    return (*own, *model.actuator_gainprm[a], *model.actuator_biasprm[a], *model.actuator_gear[a])
