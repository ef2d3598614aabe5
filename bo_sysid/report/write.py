"""The figures of a run, written into its folder."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bo_sysid.mjcf import Model
from bo_sysid.report import diagnosis_figures, figures
from bo_sysid.report.robot import Posed, Site, find_site
from bo_sysid.report.robot_figure import robot
from bo_sysid.runs import Run


def write_figures(run: Run) -> list[Path]:
    """Draw what an identification left in a run folder.

    Returns:
        The paths of the figures.

    Raises:
        RunError: a file of the run is missing or damaged.
    """
    parameters = pd.DataFrame(run.read_json("identification.json")["parameters"])
    return _written(
        run,
        {
            "marginals": figures.marginals(run.read_frame("belief.parquet"), parameters),
            "progress": figures.progress(run.read_frame("evaluations.parquet")),
            "predictions": figures.predictions(run.read_frame("traces.parquet")),
        },
    )


def write_diagnosis_figures(run: Run) -> list[Path]:
    """Draw what a diagnosis left in a run folder.

    Returns:
        The paths of the figures.

    Raises:
        RunError: a file of the run is missing or damaged.
    """
    diagnosis = run.read_json("diagnosis.json")
    posed, sites = marked_robot(run.path(diagnosis["model"]), run.read_json("pose.json"), diagnosis)
    drawn = {
        "robot": robot(posed, sites),
        "forces": diagnosis_figures.forces(run.read_frame("forces.parquet")),
        "evidence": diagnosis_figures.evidence(run.read_frame("sets.parquet")),
    }
    traces = run.read_frame("traces.parquet")
    if len(traces):
        unit = diagnosis["holdout"]["free_run"].get("unit", "rad or m")
        drawn["held_out"] = diagnosis_figures.held_out(traces, unit)
    return _written(run, drawn)


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
    return posed, [(find_site(posed, kind, name), words) for kind, name, words in said(diagnosis)]


def said(diagnosis: Mapping[str, object]) -> list[tuple[str, str, str]]:
    """Return kind and name of each guilty site with what a diagnosis says of it in a few words."""
    findings, unexplained = diagnosis["findings"], diagnosis["unexplained"]
    assert isinstance(findings, list) and isinstance(unexplained, dict)  # noqa: S101, PT018
    words: dict[tuple[str, str], list[str]] = {}
    for f in findings:
        half = 0.5 * (f["interval"][1] - f["interval"][0])
        amount = f"{f['effect'].replace('_', ' ')} {f['value']:.3g} ± {half:.2g} {f['unit']}"
        words.setdefault((f["kind"], f["site"]), []).append(amount.removesuffix(" –"))
    if unexplained["kind"] is not None:
        key = (unexplained["kind"], unexplained["site"])
        words.setdefault(key, []).append("a force of unknown origin")
    return [
        (kind, name, "\n".join([("the machine" if kind == "world" else name) + ":", *lines]))
        for (kind, name), lines in words.items()
    ]


def _written(run: Run, drawn: Mapping[str, Figure]) -> list[Path]:
    for name, figure in drawn.items():
        with run.writing(f"figures/{name}.png") as path:
            figures.save(figure, path)
    return [run.path(f"figures/{name}.png") for name in drawn]
