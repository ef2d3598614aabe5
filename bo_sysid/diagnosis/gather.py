"""From a study and its recordings to what a diagnosis is made from."""

from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.effects import chosen
from bo_sysid.execution import threads
from bo_sysid.recording import Recording
from bo_sysid.simulation.of_study import study_laws
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model, study_effects
from bo_sysid.study.requirements import (
    require_known,
    require_limits,
    require_recorded,
    require_scales,
)


def gather(study: Study, recordings: tuple[Recording, ...], kept: FitCache = NO_CACHE) -> Evidence:
    """Return what a diagnosis is made from: scales, noise, candidates.

    Args:
        study: names the model, and what is looked for.
        recordings: those of training.
        kept: long fits that an earlier run of the same files left.

    Raises:
        UserError: study, model and recordings do not fit each other.
    """
    model = load_model(study)
    require_scales(study, model)
    require_limits(study, model)
    for recording in recordings:
        require_known(model, recording)
    require_recorded(study, model, recordings)
    return make_evidence(
        model,
        recordings,
        effects=chosen(study_effects(study), study.diagnosis.effects, study.diagnosis.exclude),
        parameters=study.parameter_set(model),
        noise=study.recordings.noise,
        most=study.diagnosis.most,
        threads=threads(),
        laws=study_laws(study, model),
        known=study.diagnosis.known,
        kept=kept,
    )
