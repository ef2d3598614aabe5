"""A plant records what it did, hides what it is, and counts."""

import mujoco
import numpy as np
import pytest
from dm_control.suite import base

from bo_sysid.errors import ModelError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.plants.excitation import multisine, smooth_random
from bo_sysid.plants.plant import Plant, PlantError
from bo_sysid.plants.python_task import class_task
from bo_sysid.plants.tasks import Start, find_task

GENERAL = """
    <general name="lagged" joint="hinge" dyntype="filter" dynprm="0.05" gainprm="2"
             ctrlrange="-1 1"/>
"""
PENDULUM = f"""
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator>{GENERAL}</actuator>
</mujoco>
"""

TASKS = [("cheetah", "run"), ("hopper", "stand"), ("swimmer", "swimmer3"), ("walker", "walk")]


def damped(value):
    def edit(spec):
        spec.joint("hinge").damping[0] = value

    return edit


@pytest.fixture(scope="module")
def pendulum():
    return Model.from_xml(PENDULUM, name="pendulum")


def matrix(recording, kind):
    return np.stack([c.values for c in recording.of_kind(kind).values()], axis=1)


def predicted(model, recording):
    """One-step predictions by a bare MjData from each recorded row."""
    data = mujoco.MjData(model)
    qpos, qvel, ctrl = (matrix(recording, k) for k in ("qpos", "qvel", "ctrl"))
    act = matrix(recording, "act") if recording.of_kind("act") else np.zeros((len(qpos), 0))
    warm = matrix(recording, "aux")
    following = np.empty((len(qpos) - 1, qpos.shape[1] + qvel.shape[1]))
    for k in range(len(following)):
        data.qpos, data.qvel, data.ctrl = qpos[k], qvel[k], ctrl[k]
        data.act[:] = act[k]
        data.qacc_warmstart = warm[k]
        mujoco.mj_step(model, data)
        following[k] = np.concatenate([data.qpos, data.qvel])
    return following


@pytest.mark.parametrize(("domain", "name"), TASKS)
def test_one_step_predictions_at_the_true_parameters_are_exact(domain, name):
    model = Model.from_dm_control(domain, name)
    task = find_task(domain, name)
    plant = Plant(model, task=task, seed=1)
    steps = round(0.6 / task.control_timestep)
    controls = smooth_random(model.compile(), steps * task.control_timestep, task.control_timestep)
    recording = plant.record(controls, warmstart=True)
    physics = model.compile()
    assert recording.channels["qpos.rootx"].time[1] == pytest.approx(physics.opt.timestep)
    told = np.concatenate([matrix(recording, "qpos"), matrix(recording, "qvel")], axis=1)
    np.testing.assert_allclose(predicted(physics, recording), told[1:], rtol=0, atol=1e-12)


def test_a_plant_with_activation_is_predicted_exactly(pendulum):
    plant = Plant(pendulum, [damped(0.7)], control_timestep=0.03)
    recording = plant.record(multisine(pendulum.compile(), 2.0, 0.03), warmstart=True)
    assert list(recording.of_kind("act")) == ["lagged"]
    told = np.concatenate([matrix(recording, "qpos"), matrix(recording, "qvel")], axis=1)
    true, nominal = pendulum.compile([damped(0.7)]), pendulum.compile()
    np.testing.assert_allclose(predicted(true, recording), told[1:], rtol=0, atol=1e-13)
    assert np.abs(predicted(nominal, recording) - told[1:]).max() > 1e-3
    held = recording.channels["ctrl.lagged"].values[:-1].reshape(-1, 3)
    assert (held == held[:, :1]).all()


def test_a_finer_time_step_is_recorded_at_the_models_rate(pendulum):
    controls = multisine(pendulum.compile(), 1.0, 0.01)
    coarse = Plant(pendulum).record(controls)
    fine = Plant(pendulum, timestep=0.00125).record(controls)
    assert fine.channels["qpos.hinge"].time == pytest.approx(coarse.channels["qpos.hinge"].time)
    difference = np.abs(matrix(fine, "qpos") - matrix(coarse, "qpos")).max()
    assert 1e-5 < difference < 0.05
    rare = Plant(pendulum, timestep=0.00125).record(controls, sample=0.05)
    np.testing.assert_array_equal(matrix(rare, "qpos"), matrix(fine, "qpos")[::5])
    with pytest.raises(UserError, match=r"0\.003 s must divide 0\.01 s"):
        Plant(pendulum, timestep=0.003)


def test_noise_has_its_stated_size_and_the_motion_is_the_same(pendulum):
    controls = multisine(pendulum.compile(), 20.0, 0.01)
    clean = Plant(pendulum).record(controls)
    noisy = Plant(pendulum, noise={"qpos": 0.002}, measured=["qpos"]).record(controls)
    error = matrix(noisy, "qpos") - matrix(clean, "qpos")
    assert np.std(error) == pytest.approx(0.002, rel=0.06)
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.08
    assert not noisy.of_kind("qvel")
    np.testing.assert_array_equal(matrix(noisy, "ctrl"), matrix(clean, "ctrl"))


def test_a_policy_is_recorded_and_its_rewards_are_counted():
    model = Model.from_dm_control("pendulum", "swingup")
    plant = Plant(model, task=find_task("pendulum", "swingup"))

    def hold(observation):
        return -5 * observation[:, 1:2] - observation[:, 2:]

    recording = plant.record(hold, steps=50, start=Start(np.array([0.05])))
    assert len(recording.channels["qpos.hinge"].values) == 51
    (trajectory,) = plant.trajectories
    assert trajectory.steps == 50
    assert trajectory.reward == 50.0
    returns = plant.evaluate(hold, 4, seed=3)
    np.testing.assert_array_equal(returns, plant.evaluate(hold, 4, seed=3))
    assert plant.evaluations == 8
    assert len(plant.trajectories) == 1


def test_the_goal_of_the_last_trajectory_is_where_its_target_was():
    plant = Plant(
        Model.from_dm_control("reacher", "easy"), task=find_task("reacher", "easy"), seed=4
    )
    seen = []

    def act(observation):
        seen.append(observation[0, 2:4])  # from the finger to the target
        return np.zeros((1, 2))

    recording = plant.record(act, steps=5)
    q0, q1 = (recording.channels[f"qpos.{j}"].values[0] for j in ("shoulder", "wrist"))
    finger = 0.12 * np.array([np.cos(q0) + np.cos(q0 + q1), np.sin(q0) + np.sin(q0 + q1)])
    np.testing.assert_allclose(plant.goal, finger + seen[0], atol=1e-9)


def test_trajectories_differ_and_a_plant_with_the_same_seed_repeats_them():
    model = Model.from_dm_control("hopper", "stand")
    controls = np.zeros((5, 4))

    def two(seed):
        plant = Plant(model, task=find_task("hopper", "stand"), seed=seed, noise={"qvel": 0.1})
        return [matrix(plant.record(controls), "qvel") for _ in range(2)]

    first, again, other = two(0), two(0), two(1)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[0] - first[1]).max() > 0.05
    assert np.abs(first[0] - other[0]).max() > 0.05


def test_more_than_the_budget_is_refused(pendulum):
    plant = Plant(pendulum, budget=1, name="arm")
    plant.record(np.zeros((3, 1)))
    with pytest.raises(PlantError, match="arm: all 1 trajectories of its budget are spent"):
        plant.record(np.zeros((3, 1)))
    with pytest.raises(PlantError, match="budget is 0; at least 1"):
        Plant(pendulum, budget=0)


@pytest.mark.filterwarnings("ignore")
def test_a_plant_that_diverges_says_when_and_keeps_what_was_recorded(pendulum):
    def falls_apart(spec):
        spec.joint("hinge").damping[0] = -40.0

    plant = Plant(pendulum, [falls_apart])
    with pytest.raises(PlantError, match="simulation diverged at") as caught:
        plant.record(np.ones((1000, 1)))
    kept = caught.value.recording
    assert 2 <= len(kept.channels["qpos.hinge"].values) < 1000
    assert "diverged" in plant.trajectories[0].fault


class Hold(base.Task):
    control_timestep, time_limit = 0.02, 1.0

    def get_observation(self, physics):
        return {"q": physics.data.qpos.copy()}

    def get_reward(self, physics):
        return 1.0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("in_python", [False, True])
def test_a_plant_that_diverges_in_its_first_step_has_recorded_nothing(in_python):
    """MuJoCo restarts it at time zero, from which time goes on as if nothing had happened."""
    motor = '<motor name="lagged" joint="hinge" gear="1e12" ctrlrange="-1 1"/>'
    model = Model.from_xml(PENDULUM.replace(GENERAL, motor), name="pendulum")
    plant = Plant(model, task=class_task(Hold, model.compile()) if in_python else None)
    with pytest.raises(PlantError, match="simulation diverged at 0 s") as caught:
        plant.record(np.ones((20, 1)))
    assert caught.value.recording is None
    assert "diverged" in plant.trajectories[0].fault


@pytest.mark.filterwarnings("ignore")
def test_a_task_in_python_that_fails_late_keeps_what_was_recorded(pendulum):
    """MuJoCo warns of a control that is no number without restarting the simulation."""
    plant = Plant(pendulum, task=class_task(Hold, pendulum.compile()))
    asked = []

    def act(observation):
        asked.append(observation)
        return np.full((1, 1), 0.3 if len(asked) <= 30 else np.nan)

    with pytest.raises(PlantError, match=r"simulation diverged at 0\.6 s") as caught:
        plant.record(act)
    assert caught.value.recording.channels["qpos.hinge"].time[-1] == pytest.approx(0.6)


@pytest.mark.filterwarnings("ignore")
def test_a_plant_that_diverges_earns_nothing_by_being_put_back_upright():
    """MuJoCo restarts it at the reference, which for a cart-pole is the goal."""

    def falls_apart(spec):
        spec.joint("hinge_1").damping[0] = -2.0

    model, task = Model.from_dm_control("cartpole", "swingup"), find_task("cartpole", "swingup")
    plant = Plant(model, [falls_apart], task=task)

    def act(observation):
        return np.ones((len(observation), 1))

    with pytest.raises(PlantError, match="diverged"):
        plant.record(act)
    assert plant.trajectories[0].reward == plant.evaluate(act, 1)[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise": {"qpos.hing": 0.1}}, "noise of 'qpos.hing'; did you mean 'qpos.hinge'"),
        ({"noise": {"qpos": -1.0}}, "noise of 'qpos' is -1.0; it must be at least 0"),
        ({"measured": ["qpo"]}, "cannot measure 'qpo'; did you mean 'qpos'"),
    ],
)
def test_wrong_arguments_name_the_rule(pendulum, arguments, message):
    with pytest.raises(UserError, match=message):
        Plant(pendulum, **arguments)


@pytest.mark.parametrize(
    ("source", "steps", "message"),
    [
        (np.zeros((3, 2)), None, r"controls \(3, 2\) must be S x 1"),
        (np.array([[0.0], [np.nan]]), None, "controls in row 1 are not finite"),
        (np.zeros((3, 1)), 4, "steps is 4; from 1 to 3"),
        (lambda o: o, None, "without a task that ends, say for how many steps"),
    ],
)
def test_wrong_controls_name_the_rule(pendulum, source, steps, message):
    plant = Plant(pendulum)
    with pytest.raises(PlantError, match=message):
        plant.record(source, steps=steps)
    assert not plant.trajectories


def test_a_plant_without_task_has_no_reward(pendulum):
    with pytest.raises(PlantError, match="without a task has no reward"):
        Plant(pendulum).evaluate(lambda o: o)


def test_excitations_stay_within_their_range_and_band(pendulum):
    model = pendulum.compile()
    slow = multisine(model, 40.0, 0.01, amplitude=0.5, band=(0.5, 2.0), seed=1)
    assert np.abs(slow).max() == pytest.approx(0.5)
    power = np.abs(np.fft.rfft(slow[:, 0])) ** 2
    frequency = np.fft.rfftfreq(len(slow), 0.01)
    within = (frequency > 0.45) & (frequency < 2.05)
    assert power[within].sum() > 0.95 * power.sum()
    noise = smooth_random(model, 200.0, 0.01, amplitude=0.9, correlation=0.2, seed=2)
    assert np.abs(noise).max() < 0.9
    x = np.arctanh(noise[:, 0] / 0.9)
    lag = np.corrcoef(x[20:], x[:-20])[0, 1]
    assert lag == pytest.approx(np.exp(-1.0), abs=0.1)
    with pytest.raises(UserError, match="must lie between 0 and half the control rate"):
        multisine(model, 1.0, 0.01, band=(1.0, 80.0))


def test_an_actuator_without_range_is_named():
    free = Model.from_xml(PENDULUM.replace('ctrlrange="-1 1"', ""), name="free")
    with pytest.raises(ModelError, match="actuator 'lagged' has no control range"):
        multisine(free.compile(), 1.0, 0.01)
    Plant(free).record(np.ones((3, 1)))


@pytest.mark.parametrize("shown_by", ["h", None])
def test_a_joint_that_nothing_measures_is_recorded_where_its_encoder_shows_it(tmp_path, shown_by):
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="h" axis="0 1 0"/>'
        '<geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".3"/>'
        '<body pos=".2 0 0"><joint name="k" axis="0 1 0" stiffness="2" damping=".05"/>'
        '<geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".5"/></body></body>'
        '</worldbody><actuator><motor name="m" joint="h" ctrlrange="-2 2"/></actuator></mujoco>'
    )
    whole = Plant(Model.from_file(tmp_path / "arm.xml"))
    hidden = Plant(Model.from_file(tmp_path / "arm.xml", unrecorded={"k": shown_by}))
    controls = np.full((200, 1), 0.4)
    all_, seen = (p.record(controls).channels for p in (whole, hidden))
    assert set(all_) - set(seen) == {"qpos.k", "qvel.k"}
    for kind in ("qpos", "qvel"):
        more = all_[f"{kind}.k"].values if shown_by else 0.0
        np.testing.assert_allclose(seen[f"{kind}.h"].values, all_[f"{kind}.h"].values + more)
        assert np.abs(all_[f"{kind}.k"].values).max() > 1e-3
