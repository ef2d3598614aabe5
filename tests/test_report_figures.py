"""Matplotlib's figures: what is drawn against what was stored."""

import numpy as np
import pandas as pd
import pytest

from bo_sysid.recording import Recording
from bo_sysid.report import interactive
from bo_sysid.report.check_figures import recording_figure
from bo_sysid.report.diagnosis_figures import forces, held_out
from bo_sysid.report.figures import predictions

EPOCH = 1_762_000_000.0  # [s] since 1970
SECONDS = {"morning": 16.0, "noon": 18.0, "evening": 15.0}


def pieces() -> pd.DataFrame:
    """Return the missing force of one joint in three sessions of one day."""
    parts = []
    for k, (name, seconds) in enumerate(SECONDS.items()):
        time = np.arange(0.05, seconds, 0.1)
        speed = np.sin(time)
        parts.append(
            pd.DataFrame(
                {
                    "recording": name, "time": EPOCH + 1200.0 * k + time,
                    "begin": EPOCH + 1200.0 * k, "joint": "boom", "position": -np.cos(time),
                    "speed": speed, "unit": "N m", "nominal": -np.sign(speed),
                    "repaired": 0.01 * speed, "sigma": 0.01,
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def traces() -> pd.DataFrame:
    """Return forecasts of a recording, from a fifth of a second after it began."""
    time = np.arange(0.2, 8.0, 0.01)
    q = np.sin(3 * time)
    return pd.DataFrame(
        {
            "recording": "evening", "time": EPOCH + time, "begin": EPOCH,
            "window": (time // 2).astype(int), "channel": "qpos.boom", "recorded": q,
            "nominal": 1.3 * q, "refitted": 1.2 * q, "repaired": q,
        }
    )  # fmt: skip


def test_missing_forces_of_several_sessions_stand_one_after_the_other() -> None:
    drawn = forces(pieces()).axes[0]
    dots = next(line for line in drawn.lines if line.get_label() == "nominal model")
    time = np.asarray(dots.get_xdata(), float)
    assert time[0] == pytest.approx(0.05, abs=1e-5)
    assert (np.diff(time) > 0).all()
    assert time[-1] == pytest.approx(sum(SECONDS.values()), rel=0.1)
    whole = interactive.forces(pieces(), "boom")
    shown = np.asarray(next(t for t in whole.data if t.xaxis == "x3").x, float)
    assert shown == pytest.approx(time, abs=1e-4)


def test_forecasts_are_drawn_from_the_start_of_their_recording() -> None:
    for figure in (
        held_out(traces()),
        predictions(traces().rename(columns={"repaired": "identified"})),
    ):
        time = np.asarray(figure.axes[0].lines[0].get_xdata(), float)
        assert time[0] == pytest.approx(0.2, abs=1e-5)
        assert time[-1] == pytest.approx(7.99, abs=1e-5)
    page = interactive.held_out(traces(), "qpos.boom")
    time = np.asarray(page.data[0].x, float)
    assert np.unique(np.round(np.diff(time), 4)).tolist() == [0.0, 0.01]


def test_stored_tables_without_a_beginning_start_at_their_first_row() -> None:
    figure = held_out(traces().drop(columns="begin"))
    assert figure.axes[0].lines[0].get_xdata()[0] == 0.0


def test_a_checked_recording_is_drawn_from_its_first_stamp() -> None:
    time = EPOCH + np.arange(0.0, 4.0, 0.01)
    recording = Recording.from_arrays(time, qpos={"boom": np.sin(time - EPOCH)})
    line = recording_figure(recording, set()).axes[0].lines[0]
    assert line.get_xdata()[[0, -1]] == pytest.approx([0.0, 3.99], abs=1e-5)
