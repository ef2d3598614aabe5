"""Episodes in lock-step: limits, starts, other models, interruption."""

from copy import copy

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import UserError
from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment, episode_returns
from bo_sysid.plants.tasks import find_task
from bo_sysid.simulation import ForceLaw


@pytest.fixture(scope="module")
def cheetah():
    return Model.from_dm_control("cheetah", "run").compile()


@pytest.fixture(scope="module")
def reacher():
    return Model.from_dm_control("reacher", "easy").compile()


def roll(environment, steps, seed=0):
    rng = np.random.default_rng(seed)
    shape = (steps, environment.n, environment.action_size)
    return [environment.step(a) for a in rng.uniform(-1, 1, shape)]


@pytest.mark.parametrize("threads", [2, 3])
def test_results_do_not_depend_on_threads(cheetah, threads):
    task = find_task("cheetah", "run")
    told = []
    for number in (1, threads):
        environment = BatchEnvironment(task, cheetah, 5, seed=2, threads=number)
        environment.reset()
        told.append(roll(environment, 60)[-1])
    np.testing.assert_array_equal(told[0].observation, told[1].observation)
    np.testing.assert_array_equal(told[0].reward, told[1].reward)


def test_staggered_episodes_end_evenly_spread_and_are_truncated(reacher):
    environment = BatchEnvironment(find_task("reacher", "easy"), reacher, 4, stagger=True)
    environment.reset()
    steps = roll(environment, 1000)
    ends = np.array([s.truncated for s in steps])
    assert not np.array([s.terminated for s in steps]).any()
    assert [np.flatnonzero(e).tolist() for e in ends.T] == [[999], [749], [499], [249]]
    last = steps[749]
    moved = np.abs(last.observation - last.final).max(axis=1)
    assert moved[1] > 0
    assert (moved[[0, 2, 3]] == 0).all()


def test_equal_seeds_give_equal_starts_whatever_the_model_and_the_number(cheetah):
    task = find_task("cheetah", "run")

    def heavy(factor):
        model = Model.from_dm_control("cheetah", "run").compile()
        model.body_mass[:] *= factor
        return model

    nominal = BatchEnvironment(task, cheetah, 3, seed=7).reset()
    more = BatchEnvironment(task, cheetah, 6, seed=7, threads=2).reset()
    np.testing.assert_array_equal(nominal, more[:3])
    assert np.abs(more[3:] - nominal).max() > 0.1
    other = BatchEnvironment(task, [heavy(1.5)] * 3, 3, seed=7)
    assert 1e-4 < np.abs(other.reset() - nominal).max() < 1.0, "settled differently"
    starts = [task.draw_start(cheetah, np.random.default_rng((7, i, 0, 0))) for i in range(3)]
    np.testing.assert_array_equal(other.begin(starts)[:, :8], [s.qpos[1:] for s in starts])


def test_several_models_can_be_under_the_same_starts(reacher):
    heavy = Model.from_dm_control("reacher", "easy").compile()
    heavy.body_mass[:] *= 2
    task = find_task("reacher", "easy")
    both = BatchEnvironment(task, [reacher] * 3 + [heavy] * 3, 6, seed=2, common=3)
    begin = both.reset()
    np.testing.assert_array_equal(begin[:3], begin[3:])
    np.testing.assert_array_equal(begin[:3], BatchEnvironment(task, reacher, 3, seed=2).reset())
    moved = both.step(np.ones((6, 2))).final
    assert (np.abs(moved[:3, 4:] - moved[3:, 4:]) > 1e-6).all()


def test_an_interrupted_environment_goes_on_exactly():
    task = find_task("hopper", "hop")
    hopper = Model.from_dm_control("hopper", "hop").compile()

    def fresh():
        environment = BatchEnvironment(task, hopper, 4, seed=1, stagger=True)
        environment.reset()
        return environment

    whole = fresh()
    roll(whole, 300)
    state = whole.get_state()
    expected = roll(whole, 300, seed=1)
    resumed = fresh()
    np.testing.assert_array_equal(resumed.set_state(state), state["observation"])
    for a, b in zip(expected, roll(resumed, 300, seed=1), strict=True):
        np.testing.assert_array_equal(a.observation, b.observation)
        np.testing.assert_array_equal(a.reward, b.reward)
        np.testing.assert_array_equal(a.truncated, b.truncated)


def pushing(motion):
    """A force that depends on how often it was asked and on the time since the start."""
    asked = motion.memory.get("asked", np.zeros(len(motion.time))) + 1
    motion.memory["asked"] = asked
    return 5 * np.sin(0.05 * asked) + 3 * np.sin(8 * motion.time)


def short_cheetah(n, **options):
    """Episodes of 0.3 s that begin with 2 s of settling."""
    task = copy(find_task("cheetah", "run"))
    task.time_limit = 0.3
    model = Model.from_dm_control("cheetah", "run").compile()
    environment = BatchEnvironment(
        task, model, n, seed=4, laws=[ForceLaw("bthigh", pushing)], **options
    )
    environment.reset()
    return environment


def test_laws_see_the_time_since_the_episode_began():
    """It settled for two seconds before."""
    seen = []

    def watching(motion):
        seen.append(motion.time.copy())
        return np.zeros(len(motion.time))

    model = Model.from_dm_control("cheetah", "run").compile()
    environment = BatchEnvironment(
        find_task("cheetah", "run"), model, 2, laws=[ForceLaw("bthigh", watching)]
    )
    environment.reset()
    settled = len(seen)
    assert settled == 200
    environment.step(np.zeros((2, 6)))
    np.testing.assert_array_equal(seen[settled:], [[0.0, 0.0]])
    environment.step(np.zeros((2, 6)))
    np.testing.assert_allclose(seen[-1], model.opt.timestep)


@pytest.mark.parametrize(
    ("domain", "task", "geom"), [("reacher", "easy", "finger"), ("swimmer", "swimmer6", "target")]
)
def test_rewards_are_of_each_simulations_own_model(domain, task, geom):
    """A size that decides the reward may be what is uncertain."""
    models = []
    for factor in (1.0, 3.0, 9.0):
        models.append(Model.from_dm_control(domain, task).compile())
        models[-1].geom(geom).size[0] *= factor
    found = find_task(domain, task)

    def rewards(some):
        environment = BatchEnvironment(found, some, len(some), seed=3, common=8)
        environment.reset()
        actions = np.zeros((len(some), environment.action_size))
        return np.array([environment.step(actions).reward for _ in range(3)]).T

    together = rewards([m for m in models for _ in range(8)])
    alone = [rewards([m] * 8) for m in models]
    np.testing.assert_array_equal(together, np.concatenate(alone))
    assert (alone[2].mean() - alone[0].mean()) > 0.05


def test_a_law_with_a_memory_acts_on_each_simulation_as_on_one_alone():
    actions = np.random.default_rng(2).uniform(-1, 1, (100, 3, 6))
    alone, together = short_cheetah(1), short_cheetah(3, stagger=True)
    ended = np.zeros(3, int)
    for a in actions:
        one, all_three = alone.step(a[:1]), together.step(a)
        np.testing.assert_array_equal(all_three.final[0], one.final[0])
        ended += all_three.truncated
    assert ended.min() >= 3


def test_an_interrupted_environment_goes_on_exactly_under_a_law_with_a_memory():
    whole, resumed = short_cheetah(3, stagger=True), short_cheetah(3, stagger=True)
    roll(whole, 17)
    resumed.set_state(whole.get_state())
    for a, b in zip(roll(whole, 40, seed=1), roll(resumed, 40, seed=1), strict=True):
        np.testing.assert_array_equal(a.final, b.final)


def test_a_model_is_drawn_for_every_episode_and_survives_an_interruption(reacher):
    model = Model.from_dm_control("reacher", "easy")
    task = find_task("reacher", "easy")
    drawn = []

    def draw(rng):
        own = model.compile()
        own.dof_damping[:] = rng.uniform(0.001, 0.1)
        drawn.append(own.dof_damping[0])
        return own

    environment = BatchEnvironment(task, draw, 3, seed=4, stagger=True)
    environment.reset()
    assert len(set(drawn)) == 3
    roll(environment, 700)
    assert len(set(drawn)) == 5
    state = environment.get_state()
    expected = roll(environment, 50, seed=1)[-1]
    resumed = BatchEnvironment(task, draw, 3, seed=4)
    resumed.set_state(state)
    np.testing.assert_array_equal(roll(resumed, 50, seed=1)[-1].observation, expected.observation)


def test_episode_returns_are_the_sums_over_one_episode(reacher):
    environment = BatchEnvironment(find_task("reacher", "easy"), reacher, 3, seed=9)

    def still(observation):
        return np.zeros((3, 2))

    total = episode_returns(environment, still)
    begin = BatchEnvironment(find_task("reacher", "easy"), reacher, 3, seed=9).reset()
    touching = np.linalg.norm(begin[:, 2:4], axis=1) <= 0.06
    np.testing.assert_array_equal(total, 1000.0 * touching)


def test_a_simulation_that_diverges_ends_its_episode_without_reward(cheetah):
    environment = BatchEnvironment(find_task("cheetah", "run"), cheetah, 2)
    environment.reset()
    environment.sims.qvel[1] = np.inf
    step = environment.step(np.zeros((2, 6)))
    assert step.terminated.tolist() == [False, True]
    assert step.reward[1] == 0.0
    assert np.isfinite(step.observation).all()
    assert not environment.step(np.zeros((2, 6))).terminated.any()


def test_wrong_arguments_name_the_rule(cheetah):
    with pytest.raises(UserError, match="n is 0; at least 1"):
        BatchEnvironment(find_task("cheetah", "run"), cheetah, 0)
    with pytest.raises(UserError, match="1 models for 2 simulations"):
        BatchEnvironment(find_task("cheetah", "run"), [cheetah], 2)
    half = Model.from_dm_control("cheetah", "run").compile(timestep=0.005)
    with pytest.raises(UserError, match=r"time steps 0\.01 and 0\.005 s cannot step together"):
        BatchEnvironment(find_task("cheetah", "run"), [cheetah, half], 2)
    finer = Model.from_dm_control("reacher", "easy").compile(timestep=0.01)
    with pytest.raises(UserError, match="task CheetahRun does not fit the model"):
        BatchEnvironment(find_task("cheetah", "run"), finer, 2)
    coarse = Model.from_dm_control("reacher", "easy").compile(timestep=0.03)
    assert isinstance(coarse, mujoco.MjModel)
    with pytest.raises(UserError, match=r"0\.03 s must divide 0\.02 s"):
        BatchEnvironment(find_task("reacher", "easy"), coarse, 2)
