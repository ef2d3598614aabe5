"""The animation of before and after: as many pictures as the piece needs, of what was recorded."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from bo_sysid.mjcf import Model
from bo_sysid.report.animation import write_animation

ARM = Path(__file__).parents[1] / "studies" / "diagnosis" / "two_link_arm.xml"


def traces(error: float) -> pd.DataFrame:
    """Return one second of an arm that swings; the nominal model is off by `error` at the end."""
    time = np.linspace(0, 1, 501)
    parts = [
        pd.DataFrame(
            {
                "recording": "holdout", "time": time, "window": 0, "channel": f"qpos.{joint}",
                "recorded": np.sin(2 * time), "nominal": np.sin(2 * time) + error * time,
                "repaired": np.sin(2 * time),
            }
        )
        for joint in ("shoulder", "elbow")
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def test_one_second_is_shown_in_real_time(tmp_path: Path) -> None:
    assert write_animation(tmp_path / "a.gif", Model.from_file(ARM), traces(0.8))
    with Image.open(tmp_path / "a.gif") as moving:
        assert 19 <= moving.n_frames <= 21
        assert moving.info["duration"] == 50
    assert (tmp_path / "a.gif").stat().st_size < 300_000


@pytest.mark.parametrize("interval", [0.008, 0.1, 0.15])
def test_what_is_slower_than_pictures_is_shown_in_real_time_as_well(
    interval: float, tmp_path: Path
) -> None:
    time = 1.7e9 + np.arange(0.0, 2.0, interval)
    piece = pd.DataFrame(
        {
            "recording": "a", "time": time, "window": 0, "channel": "qpos.elbow",
            "recorded": np.sin(time), "nominal": np.sin(time) + 0.2, "repaired": np.sin(time),
        }
    )  # fmt: skip
    assert write_animation(tmp_path / "a.gif", Model.from_file(ARM), piece)
    played = 0
    with Image.open(tmp_path / "a.gif") as moving:
        for k in range(moving.n_frames - 1):
            moving.seek(k)
            played += moving.info["duration"]
    assert 1e-3 * played == pytest.approx(time[-1] - time[0], abs=0.05)


def lines(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return where the left and the right panel of the last picture have coloured lines."""
    with Image.open(path) as moving:
        moving.seek(moving.n_frames - 1)
        picture = np.asarray(moving.convert("RGB"), int)[40:]  # below the words
    coloured = np.ptp(picture, axis=2) > 60
    half = coloured.shape[1] // 2
    return coloured[:, :half], coloured[:, half:]


def test_the_panels_differ_where_the_nominal_model_is_wrong(tmp_path: Path) -> None:
    alike = []
    for error in (0.0, 0.8):
        write_animation(tmp_path / "a.gif", Model.from_file(ARM), traces(error))
        left, right = lines(tmp_path / "a.gif")
        assert right.sum() > 100
        alike.append((left & right).sum() / (left | right).sum())
    assert alike[0] > 0.8
    assert alike[1] < 0.5


def test_a_robot_that_travels_far_is_followed(tmp_path: Path) -> None:
    slide = '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide"/>'
    model = Model.from_xml(
        f'<mujoco><worldbody><body>{slide}<geom size=".1"/></body></worldbody></mujoco>'
    )
    time = np.linspace(0, 1, 51)
    for travelled, wanted in ((0.1, 0.4), (10.0, 0.15)):  # share of the panel that it fills
        moved = {"qpos.x": travelled * time, "qpos.z": 0.0 * time}
        told = pd.concat(
            pd.DataFrame(
                {"recording": "a", "time": time, "window": 0, "channel": name, "recorded": q,
                 "nominal": q, "repaired": q}
            )
            for name, q in moved.items()
        )  # fmt: skip
        write_animation(tmp_path / "a.gif", model, told)
        left, _ = lines(tmp_path / "a.gif")
        wide = np.ptp(np.flatnonzero(left.any(axis=0))) / left.shape[1]
        assert wide > wanted


def test_a_forecast_that_strays_stays_in_its_panel_beside_a_robot_that_does_not(
    tmp_path: Path,
) -> None:
    slide = '<joint name="x" type="slide" axis="1 0 0"/>'
    model = Model.from_xml(
        f'<mujoco><worldbody><body>{slide}<geom size=".1"/></body></worldbody></mujoco>'
    )
    time = np.linspace(0, 1, 51)
    told = pd.DataFrame(
        {"recording": "a", "time": time, "window": 0, "channel": "qpos.x", "recorded": 10 * time,
         "nominal": 10 * time + 3 * time, "repaired": 10 * time}
    )  # fmt: skip
    write_animation(tmp_path / "a.gif", model, told)
    left, right = lines(tmp_path / "a.gif")
    assert not left.any()  # cut off
    assert 0 < np.ptp(np.flatnonzero(right.any(axis=0))) < right.shape[1] / 2


def test_joints_with_clocks_of_their_own_are_drawn_between_their_samples(tmp_path: Path) -> None:
    """The elbow at a third of the shoulder's rate: two in three of its samples are not there."""
    slow = traces(0.8)
    number = slow.groupby("channel").cumcount()
    gone = (slow["channel"] == "qpos.elbow") & (number % 3 > 0)
    slow.loc[gone, ["recorded", "nominal", "repaired"]] = np.nan
    drawn = {}
    for name, told in (("whole", traces(0.8)), ("slow", slow)):
        assert write_animation(tmp_path / f"{name}.gif", Model.from_file(ARM), told)
        drawn[name] = np.array(lines(tmp_path / f"{name}.gif"))
    assert (drawn["whole"] & drawn["slow"]).sum() > 0.9 * (drawn["whole"] | drawn["slow"]).sum()


def test_a_model_that_diverges_is_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    model = Model.from_file(ARM)
    late = traces(0.8)
    late.loc[late["time"] > 0.5, "nominal"] = np.nan
    assert write_animation(tmp_path / "a.gif", model, late)
    with Image.open(tmp_path / "a.gif") as moving:
        assert 10 <= moving.n_frames <= 12
    assert not write_animation(tmp_path / "b.gif", model, traces(0.8).assign(nominal=np.nan))


def test_traces_of_other_joints_show_nothing(tmp_path: Path) -> None:
    other = traces(0.1).assign(channel="qpos.knee")
    assert not write_animation(tmp_path / "a.gif", Model.from_file(ARM), other)
    assert not (tmp_path / "a.gif").exists()


def test_a_robot_of_inertials_alone_is_not_drawn(tmp_path: Path) -> None:
    link = '<joint name="{}"/><inertial pos="0 0 -.2" mass="1" diaginertia=".1 .1 .1"/>'
    arm = f"<body>{link.format('shoulder')}<body>{link.format('elbow')}</body></body>"
    bare = Model.from_xml(f"<mujoco><worldbody>{arm}</worldbody></mujoco>")
    assert not write_animation(tmp_path / "a.gif", bare, traces(0.1))
