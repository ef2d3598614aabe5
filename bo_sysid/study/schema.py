"""JSON Schema of the study file, so that editors complete and check it."""

from collections.abc import Iterable
from typing import Any

from bo_sysid.study.study import Study


def schema(
    *,
    acquisitions: Iterable[str] = (),
    choices: Iterable[str] = (),
    stops: Iterable[str] = (),
    effects: Iterable[str] = (),
    datasets: Iterable[str] = (),
) -> dict[str, Any]:
    """Return the JSON Schema of a study.

    Args:
        acquisitions: registered names for `search.acquisition` and the arms of a comparison.
        choices: registered names for `learn.choose` and the arms.
        stops: registered names for `learn.stop` and the arms.
        effects: registered effect ids, for `diagnosis` and `plant`. Effects of a person's own
            may come with `diagnosis.effect_files`, so that other names are allowed there.
        datasets: registered names of public datasets.
    """
    result = Study.model_json_schema()
    result["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    result["title"] = "bo-sysid study"
    result["description"] = "A study of bo-sysid: one file, from which everything runs."
    keys = {name: section["properties"] for name, section in result["$defs"].items()}
    keys["Search"]["candidates"]["default"] = "grid"
    for section in ("Search", "Arm"):
        _offer(keys[section]["acquisition"], acquisitions)
    for section in ("Learn", "Arm"):
        _offer(keys[section]["choose"], choices)
        _offer(keys[section]["stop"], stops)
    _offer(keys["Recordings"]["dataset"], datasets)
    _suggest(keys["PlantEffect"]["effect"], effects)
    _suggest(keys["Diagnosis"]["exclude"]["items"], effects)
    _suggest(keys["Diagnosis"]["effects"]["anyOf"][1]["items"], effects)
    return result


def _offer(value: dict[str, Any], names: Iterable[str]) -> None:
    """Allow only `names` for a text, which may be left out."""
    registered = sorted(names)
    for choice in value.get("anyOf", [value]):
        if registered and choice.get("type") == "string":
            choice["enum"] = registered


def _suggest(value: dict[str, Any], names: Iterable[str]) -> None:
    """Let editors complete `names`, and allow others."""
    registered = sorted(names)
    if registered:
        value["anyOf"] = [{"enum": registered}, {"type": value.pop("type")}]
