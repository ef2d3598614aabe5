"""What a study names: things that registries know, and files with code."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bo_sysid.study.source import KeyPath

if TYPE_CHECKING:
    from bo_sysid.study.study import Study


def names(study: "Study") -> Iterator[tuple[str, KeyPath, str]]:
    """Yield kind, key and value of every name that a registry knows."""
    yield "acquisition", ("search", "acquisition"), study.search.acquisition
    yield "choice", ("learn", "choose"), study.learn.choose
    yield "stop rule", ("learn", "stop"), study.learn.stop
    for i, arm in enumerate(study.compare.arms):
        at = ("compare", "arms", i)
        for kind, key in (
            ("acquisition", "acquisition"),
            ("choice", "choose"),
            ("stop rule", "stop"),
        ):
            if (name := getattr(arm, key)) is not None:
                yield kind, (*at, key), name
    if study.diagnosis.effects != "all":
        for i, name in enumerate(study.diagnosis.effects):
            yield "effect", ("diagnosis", "effects", i), name
    for i, name in enumerate(study.diagnosis.exclude):
        yield "effect", ("diagnosis", "exclude", i), name
    for i, effect in enumerate(study.plant.effects if study.plant else ()):
        yield "effect", ("plant", "effects", i, "effect"), effect.effect
    if study.recordings.dataset is not None:
        yield "dataset", ("recordings", "dataset"), study.recordings.dataset


def code(study: "Study") -> Iterator[tuple[str, KeyPath]]:
    """Yield every Python file that the study names, with the key that names it."""
    for name, actuator in study.actuators.items():
        yield actuator.law.rpartition(":")[0], ("actuators", name, "law")
    for i, file in enumerate(study.diagnosis.effect_files):
        yield file, ("diagnosis", "effect_files", i)
    if study.task is not None and study.task.file is not None:
        yield study.task.file, ("task", "file")
