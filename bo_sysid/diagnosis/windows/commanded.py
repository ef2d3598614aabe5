"""What actuators were told under a hypothesis, and whether their activations differ by it."""

from collections.abc import Sequence

import mujoco

from bo_sysid.effects import Filter, Part
from bo_sysid.effects.beside import as_commanded_and_measured
from bo_sysid.mjcf.commands import controlled
from bo_sysid.recording import Recording


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


def changed_activations(
    nominal: mujoco.MjModel, model: mujoco.MjModel, parts: Sequence[Part]
) -> bool:
    """Whether an actuator's activation differs by its control's filters or its own numbers.

    Args:
        nominal: for which windows were cut.
        model: of a hypothesis.
        parts: of the hypothesis.
    """
    filtered = {p.actuator for p in parts if isinstance(p, Filter)}
    for a in controlled(nominal) if nominal.na else ():
        if nominal.actuator_actnum[a]:
            name = nominal.actuator(a).name
            own, other = (
                (*m.actuator_dynprm[i], m.actuator_delay[i])
                for m, i in ((nominal, a), (model, model.actuator(name).id))
            )
            if name in filtered or own != other:
                return True
    return False
