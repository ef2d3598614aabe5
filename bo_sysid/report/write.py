"""The figures of a run, written into its folder."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bo_sysid.mjcf import Model
from bo_sysid.report import diagnosis_figures, figures
from bo_sysid.report.animation import write_animation
from bo_sysid.report.look import channel_units, error_units
from bo_sysid.report.marked import marked_robot
from bo_sysid.report.render import rendered
from bo_sysid.report.robot_figure import robot
from bo_sysid.runs import Run


def write_figures(run: Run) -> list[Path]:
    """Draw what an identification left in a run folder.

    Returns:
        The paths of the figures.

    Raises:
        RunError: a file of the run is missing or damaged.
    """
    content = run.read_json("identification.json")
    parameters = pd.DataFrame(content["parameters"])
    return _written(
        run,
        {
            "marginals": figures.marginals(run.read_frame("belief.parquet"), parameters),
            "progress": figures.progress(run.read_frame("evaluations.parquet")),
            "predictions": figures.predictions(
                run.read_frame("traces.parquet"), units=error_units(content["errors"])
            ),
        },
    )


def write_diagnosis_figures(run: Run) -> list[Path]:
    """Draw what a diagnosis left in a run folder.

    MuJoCo's own picture of the robot is among it where this machine can render.

    Returns:
        The paths of the figures.

    Raises:
        RunError: a file of the run is missing or damaged.
    """
    diagnosis = run.read_json("diagnosis.json")
    model, pose = run.path(diagnosis["model"]), run.read_json("pose.json")
    posed, sites = marked_robot(model, pose, diagnosis)
    pieces = run.read_frame("forces.parquet")
    drawn = {
        "robot": robot(posed, sites),
        "evidence": diagnosis_figures.evidence(run.read_frame("sets.parquet")),
    }
    if len(pieces):
        drawn["forces"] = diagnosis_figures.forces(pieces)
    traces = run.read_frame("traces.parquet")
    if len(traces):
        drawn["held_out"] = diagnosis_figures.held_out(traces, channel_units(pieces))
    paths = _written(run, drawn)
    paths += _animated(run, model, traces)
    points = [site.point.tolist() for site, _ in sites if site.point is not None]
    picture = run.path("figures/render.png")
    return [*paths, picture] if rendered(model, pose, points, picture) else paths


def _animated(run: Run, model: Path, traces: pd.DataFrame) -> list[Path]:
    name = "figures/before_after.gif"
    if len(traces):
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "moving.gif"
            if write_animation(made, Model.from_file(model), traces):
                return [run.write_bytes(name, made.read_bytes())]
    run.path(name).unlink(missing_ok=True)  # what an earlier run drew is not this one's
    return []


def _written(run: Run, drawn: Mapping[str, Figure]) -> list[Path]:
    for name, figure in drawn.items():
        with run.writing(f"figures/{name}.png") as path:
            figures.save(figure, path)
    return [run.path(f"figures/{name}.png") for name in drawn]
