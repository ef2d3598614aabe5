"""Orientations that are written otherwise than MuJoCo's are told by the rates beside them."""

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.attitude import find_attitudes
from bo_sysid.checks.check import check
from bo_sysid.checks.hypothesis import Wire
from bo_sysid.checks.rewired import rewired
from bo_sysid.recording import Recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.study import Study

MODEL = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody><body name="bob">JOINT
    <geom type="capsule" size=".02" fromto="0 0 0 .1 0 -.4" mass=".4"/>
    <geom type="box" size=".06 .02 .02" pos=".05 .02 -.4" mass=".2"/>
  </body></worldbody>
</mujoco>
"""
JOINTS = {"ball": '<joint name="j" type="ball"/>', "free": '<freejoint name="j"/>'}


def motion(kind: str, noise: float = 1e-4, still: bool = False):
    """Return the model, times in [s], orientations and rates in the body as MuJoCo has them."""
    model = mujoco.MjModel.from_xml_string(MODEL.replace("JOINT", JOINTS[kind]))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    if still:
        model.opt.gravity[:] = 0.0
    else:
        data.qvel[-3:] = 2.0, -1.0, 3.0
    turns, rates = [], []
    for _ in range(200):
        turned = data.qpos[-4:].copy()
        mujoco.mju_quatIntegrate(turned, noise * rng.standard_normal(3), 1.0)
        turns.append(turned)
        rates.append(data.qvel[-3:] + 30 * noise * rng.standard_normal(3))
        mujoco.mj_step(model, data, nstep=10)
    return model, 0.01 * np.arange(200), np.array(turns), np.array(rates)


def recorded(kind: str, time: np.ndarray, turns: np.ndarray, rates: np.ndarray) -> Recording:
    first = 3 if kind == "free" else 0
    qpos = {f"j.{first + k}": turns[:, k] for k in range(4)}
    return Recording.from_arrays(
        time, qpos=qpos, qvel={f"j.{first + k}": rates[:, k] for k in range(3)}
    )


def in_world(turns: np.ndarray, rates: np.ndarray) -> np.ndarray:
    out = np.empty_like(rates)
    for row, turned, rate in zip(out, turns, rates, strict=True):
        mujoco.mju_rotVecQuat(row, rate, turned)
    return out


@pytest.mark.parametrize("kind", ["ball", "free"])
@pytest.mark.parametrize("w_last", [False, True])
@pytest.mark.parametrize("inverse", [False, True])
def test_an_orientation_is_put_back_as_mujoco_has_it(kind, w_last, inverse) -> None:
    model, time, turns, rates = motion(kind)
    written = turns * [1, -1, -1, -1] if inverse else turns
    log = recorded(kind, time, written[:, [1, 2, 3, 0]] if w_last else written, rates)
    wires, flags = find_attitudes(model, [log])
    assert bool(flags) == (w_last or inverse)
    (right,) = rewired([log], wires, 0.0, "ctrl")
    first = 3 if kind == "free" else 0
    for k in range(4):
        np.testing.assert_array_equal(right.channels[f"qpos.j.{first + k}"].values, turns[:, k])
    if flags:
        assert flags[0].level == "wrong"
        assert ("x, y, z, w" in flags[0].sentence, "inverse" in flags[0].sentence) == (
            w_last,
            inverse,
        )


@pytest.mark.parametrize("kind", ["ball", "free"])
def test_rates_in_the_frame_of_the_world_are_named(kind) -> None:
    model, time, turns, rates = motion(kind)
    wires, flags = find_attitudes(model, [recorded(kind, time, turns, in_world(turns, rates))])
    assert wires == {}
    assert "qvel.j" in flags[0].sentence
    assert "are in the world's frame" in flags[0].sentence


def test_about_the_axis_that_both_frames_share_no_frame_is_blamed() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.replace("JOINT", JOINTS["ball"]))
    time = 0.01 * np.arange(200)
    half, zero = np.sin(3 * time), np.zeros(200)
    yaw = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    rates = np.stack([zero, zero, 6 * np.cos(3 * time)], axis=1)
    assert find_attitudes(model, [recorded("ball", time, yaw, rates)]) == ({}, ())
    wires, flags = find_attitudes(model, [recorded("ball", time, yaw[:, [1, 2, 3, 0]], rates)])
    assert wires["qpos.j.0"] == Wire("qpos.j.3")
    assert "frame" not in flags[0].sentence


@pytest.mark.parametrize("what", ["signs", "still", "other clock", "deg/s"])
def test_nothing_is_said_where_nothing_is_wrong_or_told(what) -> None:
    model, time, turns, rates = motion("ball", still=what == "still")
    if what == "signs":
        turns = turns * np.where(np.random.default_rng(1).random(200) < 0.5, -1.0, 1.0)[:, None]
    elif what == "still":
        turns = turns[:, [1, 2, 3, 0]]
    elif what == "deg/s":
        rates = np.rad2deg(rates)
    log = recorded("ball", time, turns, rates)
    if what == "other clock":
        wrong = recorded("ball", time, turns[:, [1, 2, 3, 0]], rates).channels
        rare = recorded("ball", time[::2], turns[::2], rates[::2]).channels
        channels = {n: (wrong if n.startswith("qpos") else rare)[n] for n in wrong}
        log = Recording("log", channels)
    assert find_attitudes(model, [log]) == ({}, ())


def test_an_orientation_without_rates_is_said_not_to_be_tested() -> None:
    model, time, turns, _ = motion("ball")
    log = Recording.from_arrays(time, qpos={f"j.{k}": turns[:, k] for k in range(4)})
    wires, (flag,) = find_attitudes(model, [log])
    assert wires == {}
    assert flag.level == "note"
    assert "was not tested: that needs the angular velocity, qvel.j.0 to qvel.j.2" in flag.sentence
    part = Recording.from_arrays(time, qpos={"j.0": turns[:, 0]})
    assert find_attitudes(model, [part]) == ({}, ())


def test_a_check_proposes_the_columns_with_which_it_has_nothing_more_to_say(tmp_path) -> None:
    _, time, turns, rates = motion("ball")
    log = recorded("ball", time, turns[:, [1, 2, 3, 0]], rates)
    write_recording(log, tmp_path / "log.parquet")
    (tmp_path / "bob.xml").write_text(MODEL.replace("JOINT", JOINTS["ball"]))
    study = {"model": "bob.xml", "recordings": {"train": ["log.parquet"]}}
    found = check(Study.from_dict(study, tmp_path))
    assert [f.kind for f in found.flags if f.level == "wrong"] == ["order"]
    assert "qpos.j.0: {from: qpos.j.3}" in found.proposal
    study["recordings"]["columns"] = found.columns
    found = check(Study.from_dict(study, tmp_path))
    assert not [f for f in found.flags if f.level == "wrong" or f.kind == "far"]
    assert found.proposal == ""
