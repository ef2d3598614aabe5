"""Matplotlib's figures: what is drawn against what was stored."""

import warnings
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.report import interactive, interactive_search
from bo_sysid.report.bins import bin_edges
from bo_sysid.report.check_figures import recording_figure
from bo_sysid.report.diagnosis_figures import evidence, forces, held_out
from bo_sysid.report.figures import marginals, predictions, save
from bo_sysid.report.look import COLOURS, top_sets, worst_channels
from bo_sysid.report.robot import Posed, find_site

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


def test_a_page_of_many_channels_shows_all_instants_of_windows_and_says_the_whole_error() -> None:
    """Of 16 channels every eighth row is drawn, and windows have eight."""
    channels, error = [f"qpos.j{k}" for k in range(16)], np.tile(np.arange(8) / 100, 400)
    time = np.arange(len(error)) / 100
    one = pd.DataFrame({"time": EPOCH + time, "begin": EPOCH, "window": np.arange(3200) // 8})
    one = one.assign(recorded=np.sin(time), nominal=np.sin(time) + error)
    many = pd.concat([one.assign(channel=c) for c in channels], ignore_index=True)
    figure = interactive.held_out(many, "qpos.j3", "rad")
    drawn = {t.name: t for t in figure.data if t.yaxis == "y2"}
    ((name, below),) = drawn.items()
    assert f"off by {np.sqrt(np.mean(error**2)):.2g} rad rms" in name
    shown = np.round(-100 * below.y[np.isfinite(below.y)]).astype(int)
    assert len(shown) <= 400
    assert set(shown) == set(range(8))


@pytest.mark.parametrize("first", [-9.0, 0.0])
def test_the_nominal_value_is_drawn_at_the_end_of_its_range_and_named(first: float) -> None:
    """Of a range from 0 a Sobol design has no 0, which is the nominal value of most friction."""
    belief = pd.DataFrame({"f": np.linspace(0.02, 1.0, 50), "d": np.linspace(0.02, 1.0, 50)})
    told = {"unit": "N m", "value": 0.3, "low95": 0.2, "high95": 0.4}
    rows = [{"name": "f", "nominal": first, **told}, {"name": "d", "nominal": 0.5, **told}]
    figure = marginals(belief.assign(P=0.02, P_boot=0.02), pd.DataFrame(rows))
    lines = [{line.get_label() for line in axis.lines} for axis in figure.axes]
    assert ["nominal" in drawn for drawn in lines] == [first == 0.0, True]
    assert "nominal" in {text.get_text() for text in figure.legends[0].get_texts()}


def test_predictions_have_the_units_of_their_channels() -> None:
    figure = predictions(
        traces().rename(columns={"repaired": "identified"}), units={"qpos.boom": "rad"}
    )
    assert [a.get_ylabel() for a in figure.axes] == [
        "qpos.boom\n[rad]", "recorded -\npredicted [rad]",
    ]  # fmt: skip


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


def test_a_checked_recording_is_drawn_in_the_order_that_is_given_and_says_what_shades_mean() -> (
    None
):
    time = np.arange(0.0, 4.0, 0.01)
    moved = {n: np.sin(time) for n in ("boom", "stick", "bucket")}
    recording = Recording.from_arrays(time, name="dig", qpos=moved)
    order = ["qpos.boom", "qpos.stick", "qpos.bucket"]
    figure = recording_figure(recording, {"qpos.bucket"}, order=order)
    assert [a.get_ylabel() for a in figure.axes] == order
    assert figure.axes[0].get_title() == "dig\nshaded: the check has a remark on it"
    shaded = [a.get_facecolor() != figure.axes[0].get_facecolor() for a in figure.axes]
    assert shaded == [False, False, True]
    assert recording_figure(recording, set(), order=order).axes[0].get_title() == "dig"


def test_of_many_channels_those_with_remarks_are_drawn() -> None:
    time = np.arange(0.0, 4.0, 0.01)
    recording = Recording.from_arrays(time, qpos={f"j{k}": np.sin(time) for k in range(12)})
    figure = recording_figure(recording, {"qpos.j11"})
    assert [a.get_ylabel() for a in figure.axes] == [f"qpos.j{k}" for k in (*range(9), 11)]
    assert "2 channels not shown" in figure.axes[0].get_title()


def test_a_plan_is_drawn_between_its_limits() -> None:
    time = np.arange(0.0, 4.0, 0.01)
    plan = Recording.from_arrays(time, name="plan", qpos={"boom": np.sin(time)})
    figure = recording_figure(plan, limits={"qpos.boom": (-2.0, np.inf)})
    dashed = [x for x in figure.axes[0].lines if x.get_linestyle() == "--"]
    assert [x.get_ydata()[0] for x in dashed] == [-2.0]
    assert figure.axes[0].get_title() == "plan\ndashed: limits"


def test_what_a_check_has_found_is_drawn_and_shaded() -> None:
    """An outlier of one sample among many, and a joint without the kind of its channel."""
    time = np.arange(40_000) * 1e-3
    angle = np.sin(time)
    angle[[12_345, 23_456]] = 50.0, -40.0
    recording = Recording.from_arrays(time, qpos={"elbow": angle}, ctrl={"m": np.cos(time)})
    one, other = recording_figure(recording, {"elbow"}).axes
    assert one.get_facecolor() != other.get_facecolor()
    assert "shaded" in one.get_title()
    x, y = one.lines[0].get_data()
    assert (x[np.argmax(y)], x[np.argmin(y)]) == pytest.approx((12.345, 23.456))
    assert (y.max(), y.min()) == (50.0, -40.0)
    assert (x[0], x[-1]) == pytest.approx((0.0, 39.999))
    assert len(x) <= 4_002
    assert (np.diff(x) > 0).all()


def test_limits_that_are_not_drawn_are_not_explained() -> None:
    time = np.arange(0.0, 4.0, 0.01)
    plan = Recording.from_arrays(time, name="plan", qpos={"boom": np.sin(time)})
    figure = recording_figure(plan, limits={"qpos.boom": (-np.inf, np.inf)})
    assert figure.axes[0].get_title() == "plan"


def test_words_of_the_evidence_stand_right_of_the_line_of_the_noise() -> None:
    sets = pd.DataFrame(
        {
            "set": ["friction", "nothing is missing", "none of these"], "effects": [1, 0, 1],
            "probability": [0.97, 0.0, 0.03], "rms": [0.96, 55.0, np.nan],
            "best": [True, False, False], "equivalent": False,
        }
    )  # fmt: skip
    words = [t for t in evidence(sets).axes[0].texts if "probability" in t.get_text()]
    assert [t.get_position()[0] for t in words] == [1.0, 1.0, 55.0]  # the most probable first


def test_the_answer_and_what_may_be_it_are_shown_however_many_sets_there_are() -> None:
    """The table ends with "none of these", whatever its probability."""
    names = [f"s{k}" for k in range(12)]
    sets = pd.DataFrame(
        {
            "set": [*names, "nothing is missing", "none of these"], "effects": [1] * 12 + [0, 1],
            "probability": [0.05] * 2 + [0.02] * 10 + [0.0, 0.7], "rms": [20.0] * 13 + [np.nan],
            "best": [k == 13 for k in range(14)], "equivalent": [k == 10 for k in range(14)],
        }
    )  # fmt: skip
    shown = list(top_sets(sets)["set"])
    assert shown == ["none of these", *names[:7], "s10", "nothing is missing"]
    bars = [p for p in evidence(sets).axes[0].patches if np.isfinite(p.get_width())]
    assert len(bars) == len(shown) - 1
    bar, words = interactive.evidence(top_sets(sets)).data
    assert np.isnan(bar.x).tolist() == [False] * (len(shown) - 1) + [True]
    assert "probability 0.7" in words.text[-1]


def test_errors_of_forecasts_are_named_outside_their_panel() -> None:
    figure = held_out(traces())
    figure.draw_without_rendering()
    below = figure.axes[1]
    legend = below.get_legend()
    assert legend is not None
    assert legend.get_window_extent().y0 >= below.get_window_extent().y1


def test_what_diverged_or_was_not_recorded_is_drawn_without_a_warning() -> None:
    calm = traces().rename(columns={"repaired": "identified"})
    lost = calm.assign(channel="qpos.lost", nominal=np.nan)
    silent = calm.assign(channel="qpos.silent", recorded=np.nan)
    both = pd.concat([calm, silent, lost], ignore_index=True)
    assert worst_channels(both) == ["qpos.lost", "qpos.boom", "qpos.silent"]
    pose = [lost.assign(channel=f"qpos.base.{k}") for k in range(7)]
    order = worst_channels(pd.concat([calm, *pose], ignore_index=True))
    assert order == [f"qpos.base.{k}" for k in range(3)] + ["qpos.boom"] + [
        f"qpos.base.{k}" for k in range(3, 7)
    ]
    arm = lost.assign(channel="qpos.arm.3")  # a hinge of that name
    assert worst_channels(pd.concat([calm, arm], ignore_index=True)) == ["qpos.arm.3", "qpos.boom"]
    predictions(both).draw_without_rendering()
    names = [t.name for t in interactive.held_out(both, "qpos.lost").data]
    assert "nominal model (no prediction)" in names
    assert "identified model (off by 0 rad rms)" in names
    low, high = interactive.held_out(both, "qpos.silent").layout.yaxis.range
    assert low < high


def test_a_channel_that_the_first_recording_lacks_is_not_drawn_of_it() -> None:
    """Of several recordings that were set aside the figure shows the first."""
    first, second = traces(), traces().assign(recording="noon", window=9)
    lost = first.assign(channel="qpos.lost", nominal=np.nan)
    other = first.assign(channel="qvel.boom", recorded=np.nan)
    told = second.assign(channel="qvel.boom")
    figure = held_out(pd.concat([first, lost, other, second, told], ignore_index=True))
    figure.draw_without_rendering()
    assert [a.get_ylabel() for a in figure.axes[::2]] == ["qpos.lost\n", "qpos.boom\n"]
    assert "nominal: no prediction" in figure.axes[1].get_legend_handles_labels()[1]


def test_of_two_predictions_that_are_the_same_both_are_seen() -> None:
    same = traces().rename(columns={"repaired": "identified"}).assign(nominal=0.0, identified=0.0)
    for axis in predictions(same).axes:
        drawn = {x.get_color(): x for x in axis.lines}
        under, over = drawn[COLOURS["nominal"]], drawn[COLOURS["identified"]]
        assert over.get_linestyle() == "--"
        assert under.get_linewidth() > over.get_linewidth()


@pytest.mark.parametrize(("joints", "label"), [(3, "j0:<br>dry friction 2 N m"), (4, "j0")])
def test_many_marked_sites_are_labelled_by_name(joints: int, label: str) -> None:
    """What is said of each would lie over what is said of the next."""
    link = '<body name="b{0}" pos="0 0 .2"><joint name="j{0}" axis="0 1 0"/><geom size=".05"/>'
    bodies = "".join(link.format(k) for k in range(joints)) + "</body>" * joints
    model = Model.from_xml(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    posed = Posed.of(model, {})
    sites = [
        (find_site(posed, "joint", f"j{k}"), f"j{k}:\ndry friction 2 N m") for k in range(joints)
    ]
    words = [t.text[0] for t in interactive.robot(posed, sites).data if t.type == "scatter3d"]
    assert len(words) == joints
    assert words[0] == label


def test_long_names_beside_panels_do_not_reach_into_each_other() -> None:
    joints = [f"left_front_leg_upper_hip_joint_{k}" for k in range(9)]
    table = pd.concat([traces().assign(channel=f"qpos.{n}", identified=0.0) for n in joints])
    time = np.arange(0.0, 4.0, 0.01)
    recording = Recording.from_arrays(time, qpos={n: np.sin(time) for n in joints})
    forecast = table.drop(columns="identified")
    for figure in (predictions(table), recording_figure(recording), held_out(forecast)):
        figure.draw_without_rendering()
        labels = [a.yaxis.label.get_window_extent() for a in figure.axes if a.get_ylabel()]
        assert not any(a.overlaps(b) for a, b in pairwise(labels))


def test_of_many_predictions_the_worst_are_drawn_and_the_others_counted() -> None:
    good = traces().assign(nominal=traces()["recorded"])
    table = pd.concat([*(good.assign(channel=f"qpos.{k}") for k in range(8)), traces()])
    drawn = predictions(table.assign(identified=0.0))
    assert "qpos.boom" in [a.get_ylabel() for a in drawn.axes]
    assert "3 channels not shown" in drawn.axes[0].get_title()


def test_a_dollar_in_a_name_begins_no_formula(tmp_path) -> None:
    """Names are the users'; those at ticks are drawn as they are, too."""
    wrong, time = r"$\frac$m_{质量", np.arange(0.0, 4.0, 0.01)
    recording = Recording.from_arrays(time, qpos={wrong: np.sin(time)}, name=wrong)
    figure = recording_figure(recording)
    figure.axes[0].set_yticks([0.0], [wrong])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save(figure, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 1000
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [wrong]


@pytest.mark.parametrize(("count", "bars"), [(41, 41), (51, 51), (61, 61), (101, 101), (202, 101)])
def test_a_flat_belief_over_a_grid_looks_flat(count: int, bars: int) -> None:
    levels = np.linspace(0.4, 0.8, count)
    belief = pd.DataFrame({"mass": levels, "arm": levels, "P": 1 / count, "P_boot": 1 / count})
    edges = bin_edges(levels)
    assert len(edges) == bars + 1
    assert edges[[0, -1]] == pytest.approx([0.4 - 0.2 / (count - 1), 0.8 + 0.2 / (count - 1)])
    told = {"nominal": 0.5, "value": 0.5, "low95": 0.4, "high95": 0.8}
    axis = marginals(belief, pd.DataFrame([{"name": "mass", "unit": "kg", **told}])).axes[0]
    drawn = [bar.get_height() for part in axis.containers for bar in part]
    assert drawn == pytest.approx([1 / bars] * 2 * bars)
    for trace in interactive_search.marginal(belief, "mass", "kg", 0.5).data:
        assert trace.y == pytest.approx([1 / bars] * bars)
        assert trace.x == pytest.approx((edges[:-1] + edges[1:]) / 2)
    figure = interactive_search.pair(belief, "mass", "arm", {"mass": "kg", "arm": "m"})
    (both,), axes = figure.data, (figure.layout.yaxis, figure.layout.xaxis)
    assert [axis.title.text for axis in axes] == ["mass [kg]", "arm [m]"]
    assert both.z == pytest.approx(np.eye(bars) / bars)


@pytest.mark.parametrize("value", [5.0, -2e-6, 0.0])
def test_a_parameter_with_one_value_has_a_bar_that_can_be_seen(value: float) -> None:
    """As one that a search zooms in on until the recordings tell no more."""
    belief = pd.DataFrame({"mass": [value] * 3, "P": [0.2, 0.3, 0.5], "P_boot": [0.1, 0.2, 0.7]})
    told = {"nominal": value, "value": value, "low95": value, "high95": value}
    axis = marginals(belief, pd.DataFrame([{"name": "mass", "unit": "kg", **told}])).axes[0]
    bars = [p for p in axis.patches if p.get_width() > 0 and p.get_height() == pytest.approx(1.0)]
    low, high = axis.get_xlim()
    assert any(bar.get_width() > 0.2 * (high - low) for bar in bars)
    assert low < value < high
    assert high - low > 0.01 * abs(value)
