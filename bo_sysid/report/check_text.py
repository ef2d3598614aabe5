"""What `check` found, in words and tables."""

import numpy as np
import pandas as pd

from bo_sysid.checks.check import Checked
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.search import SUSPICIOUS
from bo_sysid.checks.wiring_text import drowned
from bo_sysid.report.text import overview_text, table

_NOTHING_TO_CORRECT = (
    "Signs, units, order, zeros and clocks: nothing to correct. An error that makes less than "
    f"{100 * SUSPICIOUS:.0f} % of a joint's forces, as of a zero by degrees, is not seen here: "
    "`diagnose` looks for it."
)
_TITLES = {
    "wrong": "To be corrected before anything is fitted:",
    "look": "To be looked at:",
    "note": "Good to know:",
}
_TOLD = 10.0  # [ms] standard deviation from which a delay says nothing
_MOST = 12  # remarks of one level that are shown


def checked_text(found: Checked, *, whole: bool = False) -> str:
    """Return all that was checked, the most serious last, where the eye is.

    Args:
        found: what the check found.
        whole: with every note and remark, for a file.
    """
    parts = [overview_text(found.summary, most=None) if whole else overview_text(found.summary)]
    if len(found.motion):
        parts += ["", "How the joints moved (speed: root mean square):", table(_motion(found))]
    if len(found.wiring.delays):
        shown = found.wiring.delays.rename(
            columns={"delay": "delay [ms]", "sigma": "± (68 %) [ms]"}
        )
        unknown_delay = ~(found.wiring.delays["sigma"] < _TOLD)
        shown.loc[unknown_delay, ["delay [ms]", "± (68 %) [ms]"]] = np.nan
        parts += ["", "When the controls act, after their stamps:", table(shown)]
    if len(found.parameters):
        shown = found.parameters.rename(
            columns={"sigma": "± (68 %)", "of_range": "of range", "determined": "identifiable"}
        )
        parts += ["", "What these recordings can say at best, of the model as it is:", table(shown)]
    for level in ("note", "look", "wrong"):
        flags = [f for f in found.flags if f.level == level]
        if flags:
            parts += ["", _TITLES[level], *_listed(flags, None if whole else _MOST)]
    if found.proposal:
        indented = "\n".join(f"  {line}" for line in found.proposal.splitlines())
        sure = any(f.level == "wrong" for f in found.flags)
        where = "Put this into the study:" if sure else "If so, put this into the study:"
        if found.dataset is not None:
            where = (
                f"The data set {found.dataset} brings its own rules; in a study of your own files, "
                "write:"
            )
        parts += ["", where, "recordings:", indented]
    elif not any(f.level == "wrong" or f.kind == "outlier" for f in found.flags) and _tested(found):
        parts += ["", _NOTHING_TO_CORRECT]
    return "\n".join(parts)


def _tested(found: Checked) -> bool:
    """Whether the motion could show a wrong channel: the model explains the forces."""
    used = found.wiring.balance[found.wiring.balance["used"].astype(bool)]
    tested = len(used) > 0 and drowned(used).empty
    return tested and float(used["after"].max()) <= SUSPICIOUS


def _motion(found: Checked) -> pd.DataFrame:
    columns = {"low_hz": "from [Hz]", "high_hz": "to [Hz]"}
    return found.motion.drop(columns="net").rename(columns=columns)


def _listed(flags: list[Flag], most: int | None) -> list[str]:
    left = len(flags[most:]) if most is not None else 0
    more = [f"- and {left} more"] if left else []
    return [*(f"- {f.sentence}" for f in flags[:most]), *more]
