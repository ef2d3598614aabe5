"""The figures of a run, written into its folder."""

from pathlib import Path

import pandas as pd

from bo_sysid.report import figures
from bo_sysid.runs import Run


def write_figures(run: Run) -> list[Path]:
    """Draw what an identification left in a run folder.

    Returns:
        The paths of the figures.

    Raises:
        RunError: a file of the run is missing or damaged.
    """
    parameters = pd.DataFrame(run.read_json("identification.json")["parameters"])
    drawn = {
        "marginals": figures.marginals(run.read_frame("belief.parquet"), parameters),
        "progress": figures.progress(run.read_frame("evaluations.parquet")),
        "predictions": figures.predictions(run.read_frame("traces.parquet")),
    }
    for name, figure in drawn.items():
        with run.writing(f"figures/{name}.png") as path:
            figures.save(figure, path)
    return [run.path(f"figures/{name}.png") for name in drawn]
