"""What stands beside a model, for those who simulate it without a recording: forces alone."""

from bo_sysid.effects import Filter
from bo_sysid.mjcf import Model
from bo_sysid.simulation import ForceLaw
from bo_sysid.simulation.of_study import recorded_input, study_laws
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_parts


def simulated_forces(study: Study, model: Model, cannot: str) -> tuple[ForceLaw, ...]:
    """Return the forces that stand beside a model, to be stepped with it.

    Args:
        study: names what stands beside its model.
        model: of the study.
        cannot: begins what is said of a refusal, such as "excite cannot plan".

    Raises:
        StudyError: a force depends on what is only recorded, or a command is changed on its way.
    """
    key, parts = ("model", "beside"), load_parts(study, model)
    changed = dict.fromkeys(p.actuator for p in parts if isinstance(p, Filter))
    if changed:
        raise study.error(
            key,
            f"{cannot} through what changes the commands of {', '.join(changed)} beside the "
            "model, such as a delay; leave that effect out",
        )
    forces = tuple(law for law in study_laws(study, model) if isinstance(law, ForceLaw))
    missing = recorded_input(model, forces)
    if missing is not None:
        raise study.error(
            key,
            f"a force beside the model depends on {missing!r}, which is recorded and not "
            f"simulated: {cannot} under it; leave it out",
        )
    return forces
