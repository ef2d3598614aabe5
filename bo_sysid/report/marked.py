"""The robot of a diagnosis in a recorded pose, with what is said of each guilty site."""

from collections.abc import Mapping
from pathlib import Path

from bo_sysid.intervals import Quantity, amount
from bo_sysid.mjcf import Model
from bo_sysid.report.robot import Posed, Site, find_site


def marked_robot(
    model: Path, pose: Mapping[str, float], diagnosis: Mapping[str, object]
) -> tuple[Posed, list[tuple[Site, str]]]:
    """Return a model in a pose, and the sites of a diagnosis with what is said of them.

    Args:
        model: the repaired model's file.
        pose: by position channel.
        diagnosis: what `diagnosis.json` holds.

    Raises:
        ModelError: the model cannot be read.
    """
    posed = Posed.of(Model.from_file(model), pose)
    return posed, [
        (find_site(posed, kind, name), words) for kind, name, words in site_labels(diagnosis)
    ]


def site_labels(diagnosis: Mapping[str, object]) -> list[tuple[str, str, str]]:
    """Return kind and name of each guilty site with what a diagnosis says of it in a few words."""
    findings, unexplained = diagnosis["findings"], diagnosis["unexplained"]
    assert isinstance(findings, list) and isinstance(unexplained, dict)  # noqa: S101, PT018
    words: dict[tuple[str, str], list[str]] = {}
    for f in findings:
        size = amount(Quantity(f["value"], f["unit"], tuple(f["interval"])))
        more = f["value"] > 0 and f["after"] != f["value"]  # than the model has
        sign = "+" if more and not size.startswith("+") else ""
        line = f"{f['effect'].replace('_', ' ')} {sign}{size}"
        words.setdefault((f["kind"], f["site"]), []).append(line)
    if unexplained["kind"] is not None:
        key = (unexplained["kind"], unexplained["site"])
        words.setdefault(key, []).append("a force of unknown origin")
    return [
        (kind, name, "\n".join([("the machine" if kind == "world" else name) + ":", *lines]))
        for (kind, name), lines in words.items()
    ]
