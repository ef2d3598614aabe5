"""Every registered task against dm_control's own."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from dm_control import suite
from dm_control.suite import swimmer

from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment
from bo_sysid.plants.load import load_task
from bo_sysid.plants.machine import VectorMachine
from bo_sysid.plants.repeat import RepeatedTask
from bo_sysid.plants.tasks import find_task, registered
from bo_sysid.policy.store import LearnedPolicy

TASKS = [key for key in registered() if key[0] != "gymnasium"]  # compared elsewhere
STANDING = np.array([0.0, -0.1, 0.0, 0.0, -0.7, 1.4, -0.7])  # a hopper on its foot
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
POLICIES = Path(__file__).parent / "policies"  # made by train_policies.py
SEEDS = {("reacher", "better"): 2, ("reacher", "learned"): 5}  # with targets that are reached
LEARNED = {  # rewards in 1 000 steps that random actions do not get
    "cartpole": 200.0,
    "cheetah": 60.0,
    "hopper": 15.0,
    "pendulum": 20.0,
    "reacher": 200.0,
    "walker": 100.0,
}


def reference(domain, name, seed=0):
    if (domain, name) == ("swimmer", "swimmer3"):
        return swimmer.swimmer(3, random=seed)
    return suite.load(domain, name, task_kwargs={"random": seed})


def flat(observation):
    return np.concatenate([np.ravel(v) for v in observation.values()])


class Draws:
    """A new-style generator with the methods that dm_control calls."""

    def __init__(self, seed):
        generator = np.random.default_rng(seed)
        self.uniform, self.rand = generator.uniform, generator.uniform
        self.randn = lambda *shape: generator.standard_normal(shape if shape else None)


def goal_of(environment, size):
    model = environment.physics.named.model
    return np.array(model.geom_pos["target"][:size]) if size else np.zeros(0)


def sway(t, size):
    """Smooth controls that move everything."""
    return np.sin(2 * np.pi * (0.8 + 0.3 * np.arange(size)) * t + np.arange(size))


def posture(observation, domain, size, t):
    """A controller that does better than chance, from the task's own observation."""
    if domain == "hopper":  # hold the leg's joints at a standing posture, damped
        return -4 * (observation[2:6] - STANDING[3:]) - 0.5 * observation[9:13]
    if domain == "cartpole":  # pump energy, then hold
        cosine, sine, speed, rate = observation[1], observation[2], *observation[3:5]
        if cosine > 0.9:
            return np.array([2 * observation[0] + 4 * np.arcsin(sine) + speed + rate])
        return np.array([np.sign(rate * cosine) - observation[0]])
    if domain == "pendulum":
        return np.array([np.sign(observation[2])])
    if domain == "reacher":  # move both joints towards the target, by the transposed Jacobian
        q0, q1 = observation[0], observation[0] + observation[1]
        tip = 0.12 * np.array([-np.sin(q1), np.cos(q1)])
        base = 0.12 * np.array([-np.sin(q0), np.cos(q0)]) + tip
        to_target, rate = observation[2:4], observation[4:6]
        return 80 * np.array([base @ to_target, tip @ to_target]) - 1.0 * rate
    return sway(t, size)


CASES = [(d, n, p) for d, n in TASKS for p in ("random", "better")] + [
    (*path.stem.split("-"), "learned") for path in sorted(POLICIES.glob("*.npz"))
]


@pytest.mark.parametrize(("domain", "name", "policy"), CASES)
def test_observation_and_reward_equal_dm_control_step_by_step(domain, name, policy):
    other = reference(domain, name, seed=SEEDS.get((domain, policy), 1))
    task = find_task(domain, name)
    ours = BatchEnvironment(task, other.physics.model.ptr, 2, seed=3)
    assert ours.episode_steps == round(other._step_limit)

    other.reset()
    ours.reset()
    if policy != "random" and domain == "hopper":  # its random starts lie down
        with other.physics.reset_context():
            other.physics.data.qpos[:] = STANDING
            other.physics.data.qvel[0] = 1.0
    first = flat(other.task.get_observation(other.physics))
    ours.sims.state[:] = other.physics.get_state(STATE)
    ours.sims.goal[:] = goal_of(other, task.goal_size)
    ours.sims.forward()
    np.testing.assert_allclose(task.get_observation(ours.sims)[0], first, atol=1e-13)

    rng = np.random.default_rng(0)
    observation = task.get_observation(ours.sims)[0]
    learned = LearnedPolicy.load(POLICIES / f"{domain}-{name}.npz") if policy == "learned" else None
    total = 0.0
    for k in range(999):
        if learned is not None:
            action = learned.act(observation[None])[0].astype(float)
        elif policy == "random":
            action = rng.uniform(-1, 1, ours.action_size)
        else:
            t = k * task.control_timestep
            action = np.clip(posture(observation, domain, ours.action_size, t), -1, 1)
        theirs = other.step(action)
        step = ours.step(np.stack([action, action]))
        observation = step.final[0]
        np.testing.assert_allclose(observation, flat(theirs.observation), rtol=0, atol=1e-11)
        np.testing.assert_allclose(step.reward, theirs.reward, rtol=0, atol=1e-12)
        total += theirs.reward
    assert not step.truncated.any()
    assert ours.step(np.zeros((2, ours.action_size))).truncated.all()
    if policy == "better" and domain in ("hopper", "cartpole", "pendulum", "reacher"):
        assert total > 5, "the comparison of rewards was empty"
    if policy == "learned":
        assert total > LEARNED[domain], "the policy is no better than chance"


@pytest.mark.parametrize(("domain", "name"), [("swimmer", "swimmer4"), ("swimmer4", "swim")])
def test_a_swimmer_of_any_length_is_dm_controls(domain, name):
    other = swimmer.swimmer(4, random=1)
    other.reset()
    task = load_task(domain, name)
    ours = BatchEnvironment(task, Model.from_dm_control(domain, name).compile(), 1)
    ours.reset()
    first = flat(other.task.get_observation(other.physics))
    ours.sims.state[:] = other.physics.get_state(STATE)
    ours.sims.goal[:] = goal_of(other, task.goal_size)
    ours.sims.forward()
    np.testing.assert_allclose(task.get_observation(ours.sims)[0], first, atol=1e-12)
    for k in range(50):
        action = sway(k * task.control_timestep, 3)
        theirs, step = other.step(action), ours.step(action[None])
        np.testing.assert_allclose(step.final[0], flat(theirs.observation), rtol=0, atol=1e-11)
        np.testing.assert_allclose(step.reward, theirs.reward, rtol=0, atol=1e-12)
    with pytest.raises(StudyError, match="no 'swimmer swimmer2' in dm_control's suite"):
        load_task("swimmer", "swimmer2")


def test_policies_were_learned_for_the_tasks_of_the_experiments():
    assert {path.stem.split("-")[0] for path in POLICIES.glob("*.npz")} == set(LEARNED)


@pytest.mark.parametrize(("domain", "name"), [("cheetah", "run"), ("cartpole", "swingup")])
def test_a_repeated_action_is_that_of_so_many_steps_of_dm_control(domain, name):
    other = reference(domain, name)
    task = RepeatedTask(find_task(domain, name), 3)
    model = other.physics.model.ptr
    ours = BatchEnvironment(task, model, 1, seed=3)
    machine = VectorMachine(task, model, 3)
    other.reset()
    ours.reset()
    machine.begin(None)
    state = other.physics.get_state(STATE)
    for sims in (ours.sims, machine._environment.sims):
        sims.state[:] = state
        sims.forward()
    rng = np.random.default_rng(0)
    for _ in range(100):
        action = rng.uniform(-1, 1, (1, ours.action_size))
        theirs = [other.step(action[0]) for _ in range(3)]
        step, applied = ours.step(action), machine.apply(ours.controls(action))
        reward = sum(t.reward for t in theirs)
        np.testing.assert_allclose(step.final[0], flat(theirs[-1].observation), atol=1e-11)
        np.testing.assert_allclose(step.reward, reward, rtol=0, atol=1e-11)
        np.testing.assert_allclose(applied.reward, reward, rtol=0, atol=1e-11)
        np.testing.assert_array_equal(applied.rows["qpos"][-1], ours.sims.qpos[0])
    assert len(applied.rows["time"]) == 3 * ours.substeps
    assert ours.episode_steps == round(other._step_limit / 3)


@pytest.mark.parametrize(("domain", "name"), TASKS)
def test_starts_are_drawn_from_dm_controls_distribution(domain, name, monkeypatch):
    # one generator with one seed, handed to both: the same draws give the same start
    other = reference(domain, name, seed=5)
    monkeypatch.setattr(type(other.physics), "step", lambda *_, **__: None)  # no settling
    monkeypatch.setattr(type(other.task), "random", Draws(5))
    other.reset()
    start = find_task(domain, name).draw_start(other.physics.model.ptr, np.random.default_rng(5))
    np.testing.assert_array_equal(start.qpos, other.physics.data.qpos)
    qvel = 0.0 if start.qvel is None else start.qvel
    np.testing.assert_array_equal(
        np.broadcast_to(qvel, other.physics.model.nv), other.physics.data.qvel
    )
    if start.goal is not None:
        np.testing.assert_allclose(start.goal, goal_of(other, 2), rtol=0, atol=1e-16)


def test_an_unknown_task_names_the_nearest():
    with pytest.raises(StudyError, match="did you mean 'cheetah run'"):
        find_task("cheetah", "runs")
