"""Trajectories that are planned: informative, and within limits for every machine they are for."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from multisine import multisines

from bo_sysid.cli import main
from bo_sysid.effects import Site, survey
from bo_sysid.effects.beside import Beside, Placed
from bo_sysid.errors import StudyError
from bo_sysid.excite.design import LEAST, design
from bo_sysid.excite.evolution import minimise
from bo_sysid.excite.excite import catalogue_parameters, excite
from bo_sysid.excite.fourier import Series
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.trial import Trial
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, ForceLaw, State
from bo_sysid.study import Study
from bo_sysid.study.outer import Limit

ROD = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" damping=".05"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/></body>
  </worldbody>
  <actuator><motor name="m" joint="hinge" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
MOTOR = '<motor name="m" joint="hinge" ctrlrange="-2 2"/>'
BRISTLES = (  # friction, as a diagnosis writes it
    '<general name="stuck" joint="hinge" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" input="none" '
    'gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" biasprm="0 0 0 .1 .15 .1" actdim="1" '
    'actearly="true"/>'
)
PARAMETERS = (
    Parameter("mass", ("geom[rod].mass",), 0.4, 0.6),
    Parameter("damping", ("joint[hinge].damping",), 0.0, 0.1),
)
LIMIT = {"hinge": Limit(position=(-0.8, 0.6), velocity=4.0, effort=1.5)}


def trial(*laws: ForceLaw) -> Trial:
    model, noise = Model.from_xml(ROD), {"qpos.hinge": 1e-3}
    limits = Limits.of(model, LIMIT)
    return Trial(model, PARAMETERS, limits, noise, seconds=3.0, interval=0.02, laws=laws)


def test_a_quadratic_is_minimised() -> None:
    target, scale = np.array([1.0, -2.0, 0.5]), np.array([1.0, 30.0, 0.1])
    best, lowest = minimise(
        lambda x: (x - target) ** 2 @ scale, np.zeros(3), 0.5, budget=1500, seed=1
    )
    np.testing.assert_allclose(best, target, atol=1e-3)
    assert lowest < 1e-6


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_cost_that_is_no_number_is_worse_than_all(bad: float) -> None:
    """Also at the start, beside which NaN let nothing count as better."""

    def cost(x: np.ndarray) -> np.ndarray:
        return np.where(x[:, 0] < 0.2, bad, ((x - 1.0) ** 2).sum(axis=1))

    told: list[float] = []
    best, lowest = minimise(
        cost, np.zeros(2), 0.5, budget=1500, seed=1, report=lambda _, low: told.append(low)
    )
    np.testing.assert_allclose(best, 1.0, atol=1e-3)
    assert 0 <= lowest < 1e-6
    assert told == sorted(told, reverse=True)
    nowhere, none = minimise(lambda x: np.full(len(x), bad), np.ones(2), 0.5, budget=40, seed=1)
    assert nowhere.tolist() == [1.0, 1.0]
    assert none == np.inf


def test_controls_start_and_end_at_rest_and_keep_their_range() -> None:
    series = Series(np.array([0.5]), np.array([2.0]), np.array([0.5, 1.5]), 4.0, 0.01)
    u = series.controls(np.array([[3.0, -4.0, 2.0, 1.0, 0.3, -0.2]]))[0]
    assert u.shape == (400, 1)
    assert u[0] == pytest.approx(0.5)
    assert u[-1] == pytest.approx(0.5, abs=0.02)
    assert u.min() == -1.5
    assert u.max() == 2.5


def test_a_limit_is_measured_where_it_is_exceeded() -> None:
    d = trial()
    still = np.zeros((150, 1))
    assert d.violation(still, d.point[None], 0.0) == pytest.approx(0.1 / 0.7)  # off the middle
    pushed = still + 1.8  # of 1.5 N m
    assert d.violation(pushed, d.point[None], 1.0) > 0.2
    run = d.run(pushed, d.point[None])
    trajectory = run.trajectory
    fastest = np.abs(trajectory.qvel).max() / 4.0
    low, high = trajectory.qpos.min(), trajectory.qpos.max()
    off = max(abs(low + 0.1), abs(high + 0.1)) / 0.7
    expected = max(fastest, off, 1.8 / 1.5)
    assert d.limits.violation(*run, 0.0)[0] == pytest.approx(expected)


DRIVES = (
    '<motor name="m" joint="hinge" gear="1.5" ctrlrange="-1 1"/>'
    '<general name="s" joint="hinge" gear="-2" gainprm="0.4" biastype="affine" '
    'biasprm="0.1 -0.6 -0.05" ctrlrange="-1 1"/>'
)
UNKNOWN = (
    Parameter("gear", ("actuator[m].gear[0]",), 1.0, 2.0),
    Parameter("gain", ("actuator[s].gainprm[0]",), 0.2, 0.8),
    Parameter("bias", ("actuator[s].biasprm[1]",), -0.9, -0.3),
)


def felt(model: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
    """Return the torque that MuJoCo's actuators make at each step, from rest."""
    data, torque = mujoco.MjData(model), []
    for now in ctrl:
        data.ctrl[:] = now
        mujoco.mj_step1(model, data)
        mujoco.mj_step2(model, data)
        torque.append(data.qfrc_actuator.copy())
    return np.array(torque)


def test_the_effort_of_each_machine_is_that_of_its_own_actuators() -> None:
    model = Model.from_xml(ROD.replace(MOTOR, DRIVES).replace(' integrator="implicitfast"', ""))
    limits = Limits.of(model, {"hinge": Limit(effort=9.0)})
    d = Trial(model, UNKNOWN, limits, {"qpos.hinge": 1e-3}, seconds=2.0, interval=0.02)
    controls = 0.5 * np.sin(np.outer(d.series.time, [3.0, 7.0]))
    run = d.run(controls, d.machines)
    expected = np.array([felt(m, u) for m, u in zip(run.models, run.ctrl, strict=True)])
    np.testing.assert_allclose(limits.torque(*run), expected, atol=1e-9)
    peaks = np.abs(expected).max(axis=(1, 2))
    assert peaks.max() > 1.2 * peaks[0]  # that of the nominal machine
    np.testing.assert_allclose(d.violations(controls, d.machines, 0.0), peaks / 9.0)
    coarse = d.judge(tuple(range(len(d.machines))))(controls[None], 0.0).over
    assert coarse[0] == pytest.approx(peaks.max() / 9.0, rel=0.05)


@pytest.mark.parametrize(
    ("drive", "joint"),
    [
        ('<position name="m" joint="hinge" kp="40" kv="2" forcerange="-2 1"/>', ""),
        ('<motor name="m" joint="hinge" gear="3"/>', ' actuatorfrcrange="-1 2"'),
        ('<position name="m" joint="hinge" kp="40" kv=".2" timeconst=".1"/>', ""),
        (
            '<general name="m" joint="hinge" dyntype="filter" dynprm=".1" gainprm="10" '
            'biastype="affine" biasprm="0 -10 -.1" actearly="true"/>',
            "",
        ),
        ('<general name="m" joint="hinge" gainprm="2" biastype="none" biasprm="1 -5 0"/>', ""),
    ],
)
def test_efforts_are_those_of_drives_that_saturate_or_lag(drive: str, joint: str) -> None:
    xml = ROD.replace(MOTOR, drive).replace('name="hinge"', f'name="hinge"{joint}', 1)
    limits = Limits.of(Model.from_xml(xml), {"hinge": Limit(effort=20.0)})
    mass = PARAMETERS[:1]
    d = Trial(Model.from_xml(xml), mass, limits, {"qpos.hinge": 1e-3}, seconds=2.0, interval=0.02)
    run = d.run(0.8 * np.sin(np.outer(d.series.time, [9.0])), d.machines[:3])
    expected = np.array([felt(m, u) for m, u in zip(run.models, run.ctrl, strict=True)])
    np.testing.assert_allclose(limits.torque(*run), expected, atol=1e-9)


def test_no_machine_within_the_bounds_of_its_gear_is_told_to_exceed_an_effort(
    tmp_path: Path,
) -> None:
    (tmp_path / "rod.xml").write_text(ROD)
    data = {
        "model": "rod.xml",
        "recordings": {"train": "later.csv"},
        "parameters": [
            {"name": "gear", "address": "actuator[m].gear[0]", "low": 1, "high": 2},
            {"name": "gain", "address": "actuator[m].gainprm[0]", "low": 0.5, "high": 0.9},
        ],
        "limits": {"hinge": {"effort": 0.9}},
    }
    plan = excite(Study.from_dict(data, tmp_path), seconds=2.0, interval=0.02, budget=30)
    assert plan.limits["ctrl.m"] == pytest.approx((-0.5, 0.5))  # 0.9 N m over 2 times 0.9
    strongest = Model.from_xml(ROD.replace(' ctrlrange="-2 2"', ' gear="2"')).compile()
    strongest.actuator_gainprm[0, 0] = 0.9
    torque = felt(strongest, np.repeat(plan.controls[["ctrl.m"]].to_numpy(), 4, axis=0))
    assert 0.3 < np.abs(torque).max() <= 0.9 + 1e-9


def test_parts_of_a_machine_that_is_larger_than_the_model_are_seen_to_touch() -> None:
    text = ROD.replace('size=".02" mass', 'size=".02" contype="1" conaffinity="1" mass').replace(
        "<body>", '<geom name="wall" type="sphere" size=".05" pos=".2 0 -.2"/><body>', 1
    )
    limits = Limits.of(Model.from_xml(text), {})
    models = [Model.from_xml(text.replace('".02"', f'"{s}"')).compile() for s in (0.02, 0.18)]
    still, ctrl = State(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 0))), np.zeros((2, 2, 1))
    run = Engine(1).rollout(models, still, ctrl)
    over = limits.violation(models, run, ctrl, 0.0)
    assert over[0] < 1.0 < over[1]


def test_series_have_the_frequencies_that_they_say() -> None:
    series = Series(np.zeros(1), np.ones(1), np.array([1.0, 2.0]), 8.0, 0.01)
    x = np.array([[0.0, 0.0, 0.0, 0.4, 0.0, 0.5]])  # the cosine of the second tone, shifted up
    power = np.abs(np.fft.rfft(series.controls(x)[0, :, 0])) ** 2
    assert np.argmax(power) / 8.0 == pytest.approx(2 * 2 ** np.tanh(0.5), abs=0.07)


def test_many_are_judged_as_one_by_one() -> None:
    d = trial()
    tones = multisines(d, 3, 7, (0.3, 4.0))
    rows = (0, 3, 9)
    found = d.judge(rows)(1.5 * tones, 0.9)
    for u, sigma, over in zip(1.5 * tones, found.sigma, found.over, strict=True):
        np.testing.assert_allclose(sigma, d.information(u).sigma, rtol=0.05)
        assert over == pytest.approx(d.violation(u, d.machines[list(rows)], 0.9), abs=0.03)


@pytest.mark.parametrize("gains", ['kp="60" kv="10"', 'kp="3000" kv="6"'])
def test_stiff_servos_are_judged_by_steps_that_they_bear(gains: str) -> None:
    """MuJoCo's own integrator, and a step of 1 ms: coarse ones of 10 ms would diverge."""
    servo = f'<position name="m" joint="hinge" {gains} ctrlrange="-2 2"/>'
    xml = ROD.replace(MOTOR, servo).replace(
        'timestep="0.005" integrator="implicitfast"', 'timestep="0.001"'
    )
    model, noise = Model.from_xml(xml), {"qpos.hinge": 1e-3}
    limits = Limits.of(model, {"hinge": Limit(position=(-0.8, 0.8), velocity=4.0)})
    d = Trial(model, PARAMETERS, limits, noise, seconds=3.0, interval=0.02)
    controls = 0.3 * d.series.fade[:, None] * np.sin(np.outer(d.series.time, [5.0]))
    found = d.judge((0, 1, 2))(controls[None], 0.0).over[0]
    exact = d.violations(controls, d.machines[:3], 0.0).max()
    assert found == pytest.approx(exact, rel=0.35)


def test_random_tones_are_flat_in_their_band_and_as_large_as_the_limits_allow() -> None:
    d = trial()
    tones = multisines(d, 16, 7, (1.0, 4.0))
    power = (np.abs(np.fft.rfft(tones[..., 0], axis=1)) ** 2).mean(axis=0)
    frequency = np.fft.rfftfreq(tones.shape[1], d.series.interval)
    inside = power[(frequency >= 1.0) & (frequency <= 4.0)]
    assert power[frequency > 6.0].max() < 0.02 * inside.mean()
    assert inside.max() < 5 * inside.min()  # 16 draws, faded in and out
    for u in tones[:3]:
        assert d.violation(u, d.proof, 1.0) == 0.0
        assert d.violation(1.15 * u, d.proof, 1.0) > 0.0


def test_a_plan_tells_more_than_random_tones_and_keeps_energy_and_the_limits_of_every_machine() -> (
    None
):
    d = trial()
    tones = multisines(d, 5, 100, (0.3, 10.0))
    before = np.median([d.information(u).sigma.max() for u in tones])
    energy = float(np.median(d.energy(tones)))
    planned = design(d, budget=200, seed=0, energy=energy)
    assert d.information(planned).sigma.max() < 0.5 * before
    assert d.violation(planned, d.proof, 1.0) == 0.0
    assert len(d.proof) == len(d.machines) + 4  # the corners of two parameters' bounds
    assert d.energy(planned) <= 1.01 * energy


def test_little_energy_goes_to_the_resonance_of_what_hardly_swings_elsewhere() -> None:
    frequency, mass = 2.0, 0.5
    model = Model.from_xml(f"""
    <mujoco><option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
    <worldbody><body><joint name="x" type="slide" axis="1 0 0" damping=".2"
      stiffness="{mass * (2 * np.pi * frequency) ** 2}"/><geom size=".05" mass="{mass}"/></body>
    </worldbody><actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator></mujoco>""")
    damping = Parameter("damping", ("joint[x].damping",), 0.1, 0.3)
    d = Trial(model, (damping,), Limits.of(model, {}), {"qpos.x": 1e-3}, seconds=8.0, interval=0.02)
    planned = design(d, budget=400, seed=0, energy=1e-3)
    power = np.abs(np.fft.rfft(planned[:, 0])) ** 2
    assert np.argmax(power) / 8.0 == pytest.approx(frequency, rel=0.1)


def test_parts_that_touch_are_seen() -> None:
    wall = ROD.replace("<worldbody>", '<worldbody><geom type="box" size=".01 1 1" pos=".25 0 0"/>')
    model = Model.from_xml(wall)
    d = Trial(
        model, PARAMETERS, Limits.of(model, {}), {"qpos.hinge": 1e-3}, seconds=2.0, interval=0.02
    )
    assert d.violation(np.zeros((100, 1)), d.point[None], 1.0) == 0.0
    assert d.violation(np.full((100, 1), -2.0), d.point[None], 1.0) > 0.0


def test_the_command_writes_controls_a_picture_and_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rod.xml").write_text(ROD)
    (tmp_path / "rod.yaml").write_text(
        "model: rod.xml\nrecordings: {train: [later.csv]}\n"
        "parameters:\n  - {name: mass, address: 'geom[rod].mass', low: 0.4, high: 0.6}\n"
        "limits: {hinge: {position: [-1, 1], velocity: 5}}\n"
    )
    assert main(["excite", "rod.yaml", "--seconds", "2", "--budget", "30", "--effects"]) == 0
    said = capsys.readouterr().out
    assert "joint[hinge].frictionloss" in said
    assert re.search(r"\n[1-9]\d* % of the limits are used", said)
    lines = (tmp_path / "runs/rod-excite/controls.csv").read_text().splitlines()
    assert lines[0] == "time,ctrl.m"
    assert len(lines) == 201
    assert (tmp_path / "runs/rod-excite/predicted.png").is_file()
    free = ("rod.yaml", "--seconds", "2", "--budget", "28", "--set", "limits={}", "--out", "free")
    assert main(["excite", *free]) == 0
    said = capsys.readouterr().out
    assert "No limits were kept" in said
    assert "limits are used" not in said


def with_beside(folder: Path, effect: Placed) -> Study:
    """A study of the rod with an effect beside its model."""
    (folder / "rod.xml").write_text(ROD)
    t = np.arange(0.0, 4.0, 0.01)
    moved = Recording.from_arrays(
        t, qpos={"hinge": np.sin(4 * t)}, ctrl={"m": np.cos(4 * t)}, aux={"voltage": 12 - t}
    )
    machine = survey(Model.from_xml(ROD).compile(), [moved])
    Beside(machine, (effect,)).write(folder / "rod.json")
    return Study.from_dict(
        {
            "model": {"file": "rod.xml", "beside": ["rod.json"]},
            "recordings": {"train": "later.csv"},
            "parameters": [{"name": "mass", "address": "geom[rod].mass", "low": 0.4, "high": 0.6}],
            "limits": {"hinge": {"position": [-0.8, 0.6], "velocity": 4}},
        },
        folder,
    )


def test_the_limits_are_kept_by_the_machine_with_the_forces_beside_its_model(
    tmp_path: Path,
) -> None:
    faster = Placed("asymmetric_damping", Site("joint", "hinge"), (-0.3,))  # 0.15 N m s/rad |v|
    found = excite(with_beside(tmp_path, faster), seconds=3.0, interval=0.02, budget=60)
    compiled = Model.from_xml(ROD).compile()
    rest = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    ctrl = np.repeat(found.controls["ctrl.m"].to_numpy(), 4)[None, :, None]
    law = ForceLaw("hinge", lambda motion: 0.15 * np.abs(motion.qvel["hinge"]))
    real = Engine(1).rollout(compiled, rest, ctrl, laws=[law])
    assert -0.8 <= real.qpos.min() < real.qpos.max() <= 0.6
    np.testing.assert_allclose(
        found.predicted.channels["qpos.hinge"].values, real.qpos[0, :-1:4, 0], atol=1e-9
    )
    plain = Engine(1).rollout(compiled, rest, ctrl)
    assert np.abs(plain.qpos - real.qpos).max() > 0.02


def test_candidates_are_judged_with_the_forces_beside_the_model() -> None:
    law = ForceLaw("hinge", lambda motion: 0.15 * np.abs(motion.qvel["hinge"]))
    d, plain = trial(law), trial()
    tones = 0.7 * multisines(d, 2, 7, (0.3, 4.0))
    found, other = (x.judge((0, 3))(tones, 0.0) for x in (d, plain))
    for u, sigma, over in zip(tones, found.sigma, found.over, strict=True):
        np.testing.assert_allclose(sigma, d.information(u).sigma, rtol=0.05)
        assert over == pytest.approx(d.violation(u, d.machines[[0, 3]], 0.0), abs=0.03)
    assert np.abs(found.over - other.over).max() > 0.06


@pytest.mark.parametrize(
    ("effect", "site", "told"),
    [
        ("actuator_deadzone", Site("actuator", "m"), "changes the commands of m beside"),
        ("voltage_sag", Site("actuator", "m"), "depends on 'aux.voltage'"),
    ],
)
def test_what_cannot_be_planned_through_is_refused(
    effect: str, site: Site, told: str, tmp_path: Path
) -> None:
    with pytest.raises(StudyError, match=rf"model.beside: .*{told}"):
        excite(with_beside(tmp_path, Placed(effect, site, (0.02,))), seconds=3.0, budget=60)


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("--seconds", "-1", "seconds is -1; it must be at least 1"),
        ("--seconds", "0.3", "seconds is 0.3; it must be at least 1"),
        ("--seconds", "nan", "seconds is nan; it must be at least 1"),
        ("--interval", "0", "interval is 0 s; it must be above 0 and at most 0.1 s"),
        ("--interval", "0.7", "interval is 0.7 s; it must be above 0"),
        ("--budget", "0", "budget is 0; at least 28 trajectories are tried"),
    ],
)
def test_wrong_arguments_say_the_rule(
    option: str, value: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rod.xml").write_text(ROD)
    study = tmp_path / "rod.yaml"
    study.write_text(
        "model: rod.xml\nrecordings: {train: [later.csv]}\n"
        "parameters:\n  - {name: mass, address: 'geom[rod].mass', low: 0.4, high: 0.6}\n"
    )
    assert main(["excite", str(study), "--out", str(tmp_path / "out"), f"{option}={value}"]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("step", ["0.3", "2"])
def test_a_model_whose_steps_are_longer_than_controls_may_be_apart_is_refused(
    step: str, tmp_path: Path
) -> None:
    (tmp_path / "rod.xml").write_text(ROD.replace("0.005", step))
    data = {
        "model": "rod.xml", "recordings": {"train": "later.csv"},
        "parameters": [{"address": "geom[rod].mass", "low": 0.4, "high": 0.6}],
    }  # fmt: skip
    with pytest.raises(StudyError, match=f"its time step is {step} s"):
        excite(Study.from_dict(data, tmp_path), seconds=2.0, budget=28)


def test_the_help_says_the_least_budget(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["excite", "--help"]) == 0
    assert f"{LEAST} or more" in " ".join(capsys.readouterr().out.split())


def test_wrong_limits_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rod.xml").write_text(ROD)
    data = {"model": "rod.xml", "recordings": {"train": "x"}, "parameters": []}
    with pytest.raises(StudyError, match="needs parameters to be known"):
        excite(Study.from_dict(data, tmp_path))
    with pytest.raises(StudyError, match="no joint 'hing'; did you mean 'hinge'"):
        Limits.of(Model.from_xml(ROD), {"hing": LIMIT["hinge"]})


def test_noise_is_of_channels_that_there_are_and_what_is_assumed_is_said(tmp_path: Path) -> None:
    (tmp_path / "rod.xml").write_text(ROD)
    mass = {"address": "geom[rod].mass", "low": 0.4, "high": 0.6}
    data = {"model": "rod.xml", "parameters": [mass]}

    def plan(noise: dict[str, float]) -> tuple[str, ...]:
        study = {**data, "recordings": {"train": ["later.csv"], "noise": noise}}
        return excite(Study.from_dict(study, tmp_path), seconds=1.0, budget=LEAST).notes

    with pytest.raises(StudyError, match=r"noise.qpos.hing: .* did you mean 'qpos.hinge'"):
        plan({"qpos.hing": 0.1})
    assert any("Noise of positions taken as 1 mrad" in note for note in plan({"qvel": 0.1}))
    assert not any("Noise of" in note for note in plan({"qpos.hinge": 0.1}))


def test_a_model_without_actuators_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rod.xml").write_text(ROD.replace(MOTOR, ""))
    mass = {"address": "geom[rod].mass", "low": 0.4, "high": 0.6}
    data = {"model": "rod.xml", "recordings": {"train": "later.csv"}, "parameters": [mass]}
    with pytest.raises(StudyError, match=r"model: excite plans controls, and .* has no actuator"):
        excite(Study.from_dict(data, tmp_path), seconds=2.0, budget=LEAST)


def test_a_limit_outside_the_range_of_its_joint_is_refused() -> None:
    ranged = Model.from_xml(ROD.replace('damping=".05"', 'damping=".05" range="0 1.5"').replace(
        "<mujoco>", '<mujoco><compiler angle="radian"/>'))  # fmt: skip
    stated = {"hinge": Limit(position=(-2.0, -1.0))}
    with pytest.raises(StudyError, match=r"hinge: position \[-2, -1\] .* range .* \[0, 1.5\]"):
        Limits.of(ranged, stated)
    with pytest.raises(StudyError, match="must overlap"):
        Limits.of(ranged, {"hinge": Limit(position=(1.5, 2.0))})  # in one point alone
    kept = Limits.of(ranged, {"hinge": Limit(position=(-2.0, 1.0))})
    np.testing.assert_allclose(kept.position, [[0.0, 1.0]])


def test_limits_that_leave_an_actuator_no_command_are_refused() -> None:
    motor = '<motor name="m" joint="hinge" ctrlrange="-2 2"/>'
    servo = '<position name="s" joint="hinge" kp="5" ctrlrange="1 2"/>'
    model = Model.from_xml(ROD.replace(motor, servo))
    limits = Limits.of(model, LIMIT)
    with pytest.raises(StudyError, match=r"limits: hinge: they leave actuator 's' no command"):
        limits.commands([model.compile()])


def test_controls_reach_as_far_as_efforts_and_positions_allow() -> None:
    text = ROD.replace(
        '<motor name="m" joint="hinge" ctrlrange="-2 2"/>',
        '<motor name="m" joint="hinge" gear="0.5"/>'
        '<position name="s" joint="hinge" kp="5"/><motor name="r" joint="hinge" ctrlrange="-2 1"/>',
    )
    model = Model.from_xml(text)
    compiled = model.compile()
    low, high = Limits.of(model, LIMIT).commands([compiled])
    np.testing.assert_allclose(low, [-3.0, -0.8, -1.5])
    np.testing.assert_allclose(high, [3.0, 0.6, 1.0])
    low, high = Limits.of(model, {}).commands([compiled])
    np.testing.assert_allclose([low, high], [[-np.inf, -np.inf, -2], [np.inf, np.inf, 1]])


def test_friction_that_is_an_actuator_without_a_control_is_planned_through(tmp_path: Path) -> None:
    text = ROD.replace(MOTOR, BRISTLES + MOTOR)
    (tmp_path / "rod.xml").write_text(text)
    data = {
        "model": "rod.xml",
        "recordings": {"train": "later.csv"},
        "parameters": [{"name": "mass", "address": "geom[rod].mass", "low": 0.4, "high": 0.6}],
        "limits": {"hinge": {"position": [-0.8, 0.6], "velocity": 4, "effort": 1.5}},
    }
    found = excite(Study.from_dict(data, tmp_path), seconds=2.0, interval=0.02, budget=30)
    assert list(found.controls) == ["time", "ctrl.m"]
    assert set(found.predicted.channels) == {"qpos.hinge", "qvel.hinge", "ctrl.m"}
    units = {n: c.unit for n, c in found.predicted.channels.items()}
    assert units == {"qpos.hinge": "rad", "qvel.hinge": "rad/s", "ctrl.m": "N m"}
    assert found.limits == {"qpos.hinge": (-0.8, 0.6), "qvel.hinge": (-4, 4), "ctrl.m": (-1.5, 1.5)}
    assert found.predicted.name == "plan"
    ctrl = np.repeat(found.controls["ctrl.m"].to_numpy(), 4)[None, :, None]
    rest = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    real = Engine(1).rollout(Model.from_xml(text).compile(), rest, ctrl)
    shown = found.predicted.channels["qpos.hinge"].values
    np.testing.assert_allclose(shown, real.qpos[0, :-1:4, 0], atol=1e-9)
    assert np.abs(found.controls["ctrl.m"]).max() <= 1.5


def test_efforts_are_those_of_the_actuators_that_have_a_control() -> None:
    model = Model.from_xml(ROD.replace(MOTOR, BRISTLES + MOTOR.replace("/>", ' gear="3"/>')))
    compiled, limits = model.compile(), Limits.of(model, LIMIT)
    np.testing.assert_allclose(limits.commands([compiled]), [[-0.5], [0.5]])
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    ctrl = np.full((1, 2, 1), 0.6)
    run = Engine(1).rollout(compiled, start, ctrl)
    assert limits.violation([compiled], run, ctrl, 0.0)[0] == pytest.approx(3 * 0.6 / 1.5)


def test_a_parameter_of_the_study_is_not_looked_for_twice_however_it_is_written() -> None:
    model = Model.from_xml(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    known = [Parameter("d", ("joint[j].damping[0]",), 0.0, 1.0, 11)]
    assert {p.name for p in catalogue_parameters(model, known)} == {
        "joint[j].frictionloss", "joint[j].armature", "joint[j].stiffness",
    }  # fmt: skip


def test_the_effort_of_an_actuator_that_integrates_is_not_known() -> None:
    model = Model.from_xml(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody><actuator>'
        '<intvelocity name="drive" joint="j" kp="40" actrange="-1 1"/></actuator></mujoco>'
    )
    with pytest.raises(StudyError, match="effort is not known of actuator 'drive'"):
        Limits.of(model, {"j": Limit(effort=1.5)})
    assert np.isinf(Limits.of(model, {"j": Limit(velocity=1.5)}).effort).all()
