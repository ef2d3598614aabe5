"""What actuators were told under a hypothesis, and whether their activations differ by it."""

from collections.abc import Sequence

import mujoco

from bo_sysid.effects import Filter, Part
from bo_sysid.effects.balance import balances
from bo_sysid.effects.beside import as_commanded_and_measured
from bo_sysid.effects.driven import is_driven
from bo_sysid.mjcf.commands import controlled
from bo_sysid.mjcf.compiling import differ
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
