"""Names that studies use and that registries know."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bo_sysid.study import Study


def registered() -> dict[str, list[str]]:
    """Return all that is registered, by the argument of `bo_sysid.study.schema`."""
    from bo_sysid.acquisition import acquisition_names
    from bo_sysid.effects import CATALOGUE
    from bo_sysid.learn import CHOICES, STOPS
    from bo_sysid.recording.datasets import DATASETS

    return {
        "acquisitions": list(acquisition_names()),
        "datasets": sorted(DATASETS),
        "effects": sorted(CATALOGUE),
        "choices": list(CHOICES),
        "stops": list(STOPS),
    }


def check_names(study: "Study") -> None:
    """Check the names in a study; only registries that it uses are imported.

    Raises:
        StudyError: a name is not registered.
    """
    from bo_sysid.acquisition import acquisition_names
    from bo_sysid.learn import CHOICES, STOPS

    study.check_names(acquisitions=acquisition_names(), choices=CHOICES, stops=STOPS)
    if study.recordings.dataset is not None:
        from bo_sysid.recording.datasets import DATASETS

        study.check_names(datasets=DATASETS)
    diagnosis = study.diagnosis
    if diagnosis.effects != "all" or diagnosis.exclude or (study.plant and study.plant.effects):
        from bo_sysid.study.inputs import study_effects

        study.check_names(effects=study_effects(study))
