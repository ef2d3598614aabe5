"""Training learns, repeats, and survives interruptions; policies survive files."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from bo_sysid.errors import RunError, StudyError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment, episode_returns
from bo_sysid.plants.tasks import Start, VectorTask, find_task
from bo_sysid.policy.settings import CriticFit, TrpoSettings, TrustRegion
from bo_sysid.policy.store import LearnedPolicy, read_arrays, write_arrays
from bo_sysid.policy.train import CHECKPOINT, LOG, POLICY, train
from bo_sysid.policy.trainer import Trainer

CART = """
<mujoco>
  <option timestep="0.05"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
SMALL = TrpoSettings(batch=2000, hidden=(16,), discount=0.95)


class Regulate(VectorTask):
    """A cart with a quadratic cost: the best gain is known from the Riccati equation."""

    control_timestep = 0.05
    time_limit = 5.0

    def draw_start(self, model, rng):
        return Start(rng.uniform(-1, 1, 1), rng.uniform(-0.3, 0.3, 1))

    def get_observation(self, sims):
        return np.concatenate([sims.qpos, sims.qvel], axis=1)

    def get_reward(self, sims):
        return -(sims.qpos[:, 0] ** 2 + 0.1 * sims.qvel[:, 0] ** 2 + 0.1 * sims.ctrl[:, 0] ** 2)


@pytest.fixture(scope="module")
def cart():
    return Model.from_xml(CART, name="cart").compile()


def fresh(cart, seed=0, threads=1):
    return BatchEnvironment(Regulate(), cart, 20, seed=seed, threads=threads, stagger=True)


def riccati(model):
    """Return the optimal linear gain of the discretised cart, saturation ignored."""
    h, mass, damping, gear = 0.05, model.body_mass[1], 0.1, 2.0
    # semi-implicit Euler with implicit damping, as MuJoCo steps it
    keep, push = mass / (mass + h * damping), h * gear / (mass + h * damping)
    A, B = np.array([[1, h * keep], [0, keep]]), np.array([[h * push], [push]])
    Q, R, P = np.diag([1.0, 0.1]), np.array([[0.1]]), np.eye(2)
    for _ in range(2000):
        P = Q + A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def test_the_learned_regulator_approaches_the_optimal_one(cart):
    training = train(fresh(cart), SMALL, steps=60_000, seed=1)
    test = BatchEnvironment(Regulate(), cart, 50, seed=99)
    gain = riccati(cart)
    best = episode_returns(test, lambda o: -o @ gain.T).mean()
    idle = episode_returns(test, lambda o: 0 * o[:, :1]).mean()
    learned = episode_returns(test, training.policy.act).mean()
    assert idle < best
    assert (learned - idle) / (best - idle) > 0.97
    log = training.log
    assert (log["kl"] <= SMALL.region.kl).all()
    assert log["accepted"].all()
    assert log["episode_return"].iloc[-1] > log["episode_return"].iloc[1]
    assert log["explained_variance"].iloc[-1] > 0.5


def test_a_kill_between_checkpoints_changes_nothing(cart, tmp_path):
    whole = train(fresh(cart), SMALL, steps=14_000, folder=tmp_path / "whole", every=2)

    class KilledError(Exception):
        pass

    def kill(row):
        if row.iteration == 5:
            raise KilledError

    folder = tmp_path / "killed"
    with pytest.raises(KilledError):
        train(fresh(cart), SMALL, steps=14_000, folder=folder, every=2, watch=kill)
    assert not (folder / POLICY).exists()
    seen = []
    resumed = train(
        fresh(cart), SMALL, steps=14_000, folder=folder, every=2, watch=lambda r: seen.append(r)
    )
    assert [row.iteration for row in seen] == [5, 6, 7]
    np.testing.assert_array_equal(resumed.policy.theta, whole.policy.theta)
    np.testing.assert_array_equal(resumed.policy.normaliser.mean, whole.policy.normaliser.mean)
    pd.testing.assert_frame_equal(resumed.log, whole.log)
    pd.testing.assert_frame_equal(pd.read_parquet(folder / LOG), whole.log)
    again = train(fresh(cart), SMALL, steps=14_000, folder=folder, every=2)
    np.testing.assert_array_equal(again.policy.theta, whole.policy.theta)


def test_results_do_not_depend_on_threads_but_on_the_seed(cart):
    theta = [
        train(fresh(cart, threads=t), SMALL, steps=4_000, seed=s, threads=t).policy.theta
        for t, s in ((1, 0), (2, 0), (1, 1))
    ]
    np.testing.assert_array_equal(theta[0], theta[1])
    assert np.abs(theta[0] - theta[2]).max() > 0.01


def test_time_limits_are_bootstrapped_and_terminations_are_not(cart):
    class Ends(Regulate):
        def is_terminated(self, sims):
            return sims.qpos[:, 0] > 0.9

    environment = BatchEnvironment(Ends(), cart, 20, stagger=True)
    trainer = Trainer(environment, SMALL)
    trainer.iterate()
    caught = {}
    estimate = trainer._estimate

    def spy(rollout):
        caught["rollout"], caught["estimate"] = rollout, estimate(rollout)
        return caught["estimate"]

    trainer._estimate = spy
    critic = trainer.critic.theta.copy()
    trainer.iterate()
    rollout, (values, advantage) = caught["rollout"], caught["estimate"]
    assert rollout.terminated.any()
    assert rollout.truncated.any()
    scaled = np.clip(rollout.rewards / np.sqrt(trainer._scale.moments.variance), -10, 10)
    trainer.critic.theta[:] = critic
    finals = trainer.critic.values(rollout.finals)
    ends = np.argwhere(rollout.ended)
    for (t, i), final in zip(ends, finals, strict=True):
        bootstrap = 0.0 if rollout.terminated[t, i] else 0.95 * final
        expected = scaled[t, i] + bootstrap - values[t, i]
        assert advantage[t, i] == pytest.approx(expected, abs=1e-4)


def test_a_policy_survives_its_file_and_refuses_another_model(cart, tmp_path):
    training = train(
        fresh(cart), SMALL, steps=2_000, folder=tmp_path, about={"task": "regulate cart"}
    )
    policy = LearnedPolicy.load(tmp_path / POLICY)
    x = np.random.default_rng(0).normal(0, 3, (50, 2))
    np.testing.assert_array_equal(policy.act(x), training.policy.act(x))
    assert policy.about == {"task": "regulate cart"}
    with np.load(tmp_path / POLICY, allow_pickle=False) as file:
        assert json.loads(str(file["_header"]))["format"] == 1
    with pytest.raises(
        UserError, match="takes 2 observations and gives 1 actions, the task has 17"
    ):
        policy.require(17, 6)
    policy.require(2, 1)


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_the_exported_policy_acts_alike(cart, tmp_path):
    policy = train(fresh(cart), SMALL, steps=2_000).policy
    policy.export(tmp_path / "policy.pt")
    x = np.random.default_rng(0).normal(0, 3, (50, 2)).astype(np.float32)
    exported = torch.jit.load(str(tmp_path / "policy.pt"))(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(exported, policy.act(x), rtol=0, atol=1e-5)
    x[:, 0] = np.nan  # a reading that is missing counts as the mean of that observation
    exported = torch.jit.load(str(tmp_path / "policy.pt"))(torch.from_numpy(x)).numpy()
    x[:, 0] = policy.normaliser.mean[0]
    np.testing.assert_allclose(exported, policy.act(x), rtol=0, atol=1e-5)


def test_a_damaged_or_foreign_file_is_named(cart, tmp_path):
    with pytest.raises(RunError, match="no such file"):
        LearnedPolicy.load(tmp_path / "none.npz")
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"PK but not really")
    with pytest.raises(RunError, match=r"bad\.npz: damaged, or no \.npz"):
        LearnedPolicy.load(bad)
    train(fresh(cart), SMALL, steps=2_000, folder=tmp_path)
    with pytest.raises(RunError, match="not a policy of format 1"):
        LearnedPolicy.load(tmp_path / CHECKPOINT)
    arrays, header = read_arrays(tmp_path / POLICY)
    del header["sizes"]
    write_arrays(bad, arrays, header)
    with pytest.raises(RunError, match=r"bad\.npz: damaged: it has no sizes"):
        LearnedPolicy.load(bad)
    np.savez(bad, _header=np.array("[1]"), **arrays)
    with pytest.raises(RunError, match="its header is no mapping"):
        LearnedPolicy.load(bad)
    with pytest.raises(RunError, match="training with other seed"):
        train(fresh(cart), SMALL, steps=2_000, seed=3, folder=tmp_path)
    with pytest.raises(RunError, match="training with other about"):
        train(fresh(cart), SMALL, steps=2_000, folder=tmp_path, about={"model": "heavier.xml"})


def test_wrong_settings_name_the_rule(cart):
    with pytest.raises(StudyError, match="batch 2010 must be a multiple of the 20 environments"):
        train(fresh(cart), TrpoSettings(batch=2010), steps=10)
    with pytest.raises(StudyError, match=r"discount is 1\.5; it must be from 0 to 1"):
        TrpoSettings(discount=1.5)
    with pytest.raises(StudyError, match="hidden"):
        TrpoSettings(hidden=())
    for wrong in ({"hidden": (8, 0)}, {"clip": 0.0}, {"log_std": np.nan}):
        with pytest.raises(StudyError, match=next(iter(wrong))):
            TrpoSettings(**wrong)
    for wrong in ({"cg_steps": 0}, {"backtracks": 0}, {"shrink": 2.0}, {"kl": np.nan}):
        with pytest.raises(StudyError, match=f"{next(iter(wrong))} is (0|2|nan)"):
            TrustRegion(**wrong)
    for wrong in ({"minibatch": 0}, {"epochs": 0}, {"rate": -1.0}):
        with pytest.raises(StudyError, match=next(iter(wrong))):
            CriticFit(**wrong)


def test_a_reward_that_is_not_finite_is_named(cart):
    class Broken(Regulate):
        def get_reward(self, sims):
            return np.where(sims.qpos[:, 0] > 0.5, np.nan, 0.0)

    environment = BatchEnvironment(Broken(), cart, 20)
    with pytest.raises(UserError, match="the task gave a reward of nan in control step"):
        train(environment, SMALL, steps=10)


@pytest.mark.parametrize(("ends", "steps"), [("truncated", 5.0), ("running", 0.05)])
def test_what_the_last_step_led_to_must_be_finite(cart, ends, steps):
    """A critic that has seen one NaN is NaN for good."""

    class Broken(BatchEnvironment):
        def step(self, actions):
            step = super().step(actions)
            if ends == "truncated":
                return step._replace(final=np.full_like(step.final, np.nan))
            return step._replace(observation=np.full_like(step.observation, np.nan))

    environment = Broken(Regulate(), cart, 20)
    settings = TrpoSettings(batch=round(20 * steps / 0.05), hidden=(16,))
    trainer = Trainer(environment, settings)
    before = trainer.critic.theta.copy()
    with pytest.raises(UserError, match=r"an observation (that is not finite|of nan)"):
        trainer.iterate()
    np.testing.assert_array_equal(trainer.critic.theta, before)


def test_a_task_may_return_live_views(cart):
    """What ended an episode is then no view of the next one's start."""

    class Live(Regulate):
        def get_observation(self, sims):
            return sims.qpos

    class Copied(Regulate):
        def get_observation(self, sims):
            return sims.qpos.copy()

    told = [
        train(BatchEnvironment(task, cart, 20, stagger=True), SMALL, steps=4_000).log
        for task in (Live(), Copied())
    ]
    pd.testing.assert_frame_equal(*told)


def test_episodes_that_a_task_cuts_are_whole(cart):
    class Cuts(BatchEnvironment):
        """Cuts every episode after 10 steps, as a time limit of its own."""

        def step(self, actions):
            step = super().step(actions)
            cut = self._steps >= 10
            if cut.any():
                self._restart(np.flatnonzero(cut))
            return step._replace(truncated=step.truncated | cut, observation=self._observation)

    class Paid(Regulate):
        def get_reward(self, sims):
            return np.ones(len(sims))

    row = Trainer(Cuts(Paid(), cart, 20), SMALL).iterate()
    # the first of each simulation may have been staggered, and is not counted
    assert (row.episodes, row.episode_return) == (20 * (100 // 10 - 1), 10.0)


def test_what_a_policy_is_learned_on_may_be_anything_that_a_file_can_hold(cart, tmp_path):
    about = {"beta": np.array([0.1, 0.2]), "by number": {1: 2}, "pair": (1, 2)}
    first = train(fresh(cart), SMALL, steps=2_000, folder=tmp_path, about=about)
    again = train(fresh(cart), SMALL, steps=2_000, folder=tmp_path, about=about)
    np.testing.assert_array_equal(first.policy.theta, again.policy.theta)
    about["beta"] = np.array([0.1, 0.3])
    with pytest.raises(RunError, match="training with other about"):
        train(fresh(cart), SMALL, steps=2_000, folder=tmp_path, about=about)


def test_every_iteration_of_a_suite_task_is_finite():
    task = find_task("pendulum", "swingup")
    model = Model.from_dm_control("pendulum", "swingup").compile()
    environment = BatchEnvironment(task, model, 10, stagger=True)
    log = train(environment, TrpoSettings(batch=2000), steps=8000).log
    kept = log.drop(columns="episode_return").to_numpy(float)
    assert np.isfinite(kept).all()
    assert log["steps"].tolist() == [2000, 4000, 6000, 8000]
