"""The evaluations of a run, written after every step, so that nothing is lost when it is killed."""

import numpy as np
import pandas as pd

from bo_sysid.deviation import Evaluation
from bo_sysid.errors import RunError
from bo_sysid.identify.search import History
from bo_sysid.parameters import CandidateSet
from bo_sysid.runs import Run

EVALUATIONS = "evaluations.parquet"
PROBLEM = "problem.json"


class Journal:
    """Keeps the history of each level of a search, in the run folder where there is one.

    Args:
        run: the run folder; None keeps the history in memory only.
        fingerprint: hash of the recordings, the model and the files that the study names.

    Raises:
        RunError: the folder holds evaluations on other recordings, another model or other files,
            or by other packages.
    """

    def __init__(self, run: Run | None, fingerprint: str) -> None:
        self._run = run
        self._frame = pd.DataFrame()
        if run is None:
            return
        run.require_same_packages()
        if run.has(PROBLEM) and run.read_json(PROBLEM)["fingerprint"] != fingerprint:
            raise RunError(
                f"{run.folder}: the recordings, the model or a file that the study names changed "
                "since this run began; use another --out, or remove the folder"
            )
        run.write_json(PROBLEM, {"fingerprint": fingerprint})
        if run.has(EVALUATIONS):
            self._frame = run.read_frame(EVALUATIONS)

    @property
    def frame(self) -> pd.DataFrame:
        """One row an evaluation: level, row, parameters, deviation, diverged, entropy, blocks."""
        return self._frame

    def history(self, level: int, blocks: int) -> History:
        """Return what was evaluated at a level of the search."""
        if self._frame.empty or not (self._frame["level"] == level).any():
            return History.empty(blocks)
        part = self._frame[self._frame["level"] == level]
        evaluation = Evaluation(
            part["deviation"].to_numpy(float),
            np.stack([np.asarray(c, float) for c in part["contributions"]]),
            part["diverged"].to_numpy(float),
        )
        return History(part["row"].to_numpy(int), evaluation, part["entropy"].to_numpy(float))

    def write(self, level: int, candidates: CandidateSet, history: History) -> None:
        """Keep the history of a level, in place of what was kept of it before."""
        part = pd.DataFrame({"level": level, "row": history.rows})
        points = candidates.frame().iloc[history.rows].reset_index(drop=True)
        part = pd.concat([part, points], axis=1).assign(
            deviation=history.evaluation.deviation,
            diverged=history.evaluation.diverged,
            entropy=history.entropy,
            contributions=list(history.evaluation.contributions),
        )
        earlier = self._frame[self._frame["level"] < level] if len(self._frame) else self._frame
        self._frame = pd.concat([earlier, part], ignore_index=True)
        if self._run is not None:
            self._run.write_frame(EVALUATIONS, self._frame)
