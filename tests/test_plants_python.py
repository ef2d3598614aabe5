"""Tasks in Python: dm_control's own answers, and the same recordings as vectorised ones."""

import sys

import mujoco
import numpy as np
import pytest
from dm_control import suite
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from bo_sysid.errors import StudyError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.plants.build import record
from bo_sysid.plants.environment import BatchEnvironment, episode_returns
from bo_sysid.plants.load import compiled, load_task, make_environment
from bo_sysid.plants.plant import Plant, PlantError
from bo_sysid.plants.python_environment import PythonEnvironment, PythonMachine
from bo_sysid.plants.python_task import PythonTask, class_task, suite_task
from bo_sysid.plants.tasks import Start, VectorTask, find_task


def roll(environment, steps, seed=0):
    rng = np.random.default_rng(seed)
    shape = (steps, environment.n, environment.action_size)
    return [environment.step(a) for a in rng.uniform(-1, 1, shape)]


class Reach(base.Task):
    """What a user might write: hold the reacher's tip still at a drawn place."""

    control_timestep = 0.04
    time_limit = 0.4

    def initialize_episode(self, physics):
        self.goal = self.random.uniform(-0.1, 0.1, 2)
        super().initialize_episode(physics)

    def get_observation(self, physics):
        return {"tip": physics.named.data.geom_xpos["finger", :2] - self.goal}

    def get_reward(self, physics):
        return -float(np.linalg.norm(physics.named.data.geom_xpos["finger", :2] - self.goal))

    def get_termination(self, physics):
        return 0.0 if abs(physics.data.qvel[0]) > 8 else None


class Arrive(Reach):
    """A user's task whose reward says what the end and the observation go by."""

    def initialize_episode(self, physics):
        self.near, self.count = False, 0
        super().initialize_episode(physics)

    def get_reward(self, physics):
        self.count += 1
        self.near = self.count >= 3
        return float(self.count)

    def get_observation(self, physics):
        return {"z": np.array([self.count]), "a": physics.data.qpos.copy()}

    def get_termination(self, physics):
        return 0.0 if self.near else None


def test_a_users_task_is_asked_in_the_order_of_dm_control():
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(Arrive, model.compile())
    model = compiled(model, task)
    ours = make_environment(task, model, 1)
    first = ours.reset()
    physics = task.physics.from_model(wrapper.MjModel(model))
    other = control.Environment(
        physics, Arrive(random=0), control_timestep=0.04, flat_observation=True
    )
    other.reset()
    state = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    physics.set_state(ours._machines[0].physics.get_state(state), state)
    physics.forward()
    for k in range(1, 4):
        action = np.full(ours.action_size, 0.1 * k)
        step, theirs = ours.step(action[None]), other.step(action)
        np.testing.assert_allclose(step.final[0], theirs.observation["observations"])
        assert step.reward[0] == theirs.reward == k
        assert step.terminated[0] == theirs.last() == (k == 3)
    assert first.shape == step.final.shape


def test_a_task_that_is_not_vectorised_is_dm_controls_own():
    task = load_task("finger", "spin")
    assert isinstance(task, PythonTask)
    assert "not vectorised" in task.notice
    model = compiled(Model.from_dm_control("finger", "spin"), task)
    ours = make_environment(task, model, 2, seed=3)
    other = suite.load("finger", "spin", task_kwargs={"random": 0})
    first = ours.reset()
    assert np.abs(first[0] - first[1]).max() > 0.01
    state = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    other.reset()
    other.physics.set_state(ours._machines[0].physics.get_state(state), state)
    other.physics.forward()
    assert ours.episode_steps == 1000
    rng = np.random.default_rng(0)
    for _ in range(100):
        action = rng.uniform(-1, 1, ours.action_size)
        theirs = other.step(action)
        step = ours.step(np.stack([action, -action]))
        flat = np.concatenate([np.ravel(v) for v in theirs.observation.values()])
        np.testing.assert_allclose(step.final[0], flat, rtol=0, atol=1e-12)
        assert step.reward[0] == theirs.reward


def test_a_task_without_end_goes_on_and_needs_a_number_of_steps():
    task = load_task("lqr", "lqr_2_1")
    assert task.time_limit == np.inf
    model = Model.from_dm_control("lqr", "lqr_2_1")
    ours = make_environment(task, compiled(model, task), 2, seed=3, stagger=True)
    assert ours.episode_steps > 10**9
    other = suite.load("lqr", "lqr_2_1", task_kwargs={"random": 0})
    controls, start = np.full((20, 1), 0.1), np.array([0.3, -0.2])
    plant = Plant(model, task=task)
    recording = plant.record(controls, start=Start(start))
    other.reset()
    with other.physics.reset_context():
        other.physics.data.qpos[:], other.physics.data.qvel[:] = start, 0.0
    for u in controls:
        other.step(u)
    shown = [recording.channels[n].values[-1] for n in model.qpos_channels]
    np.testing.assert_allclose(shown, other.physics.data.qpos, atol=1e-12)
    with pytest.raises(PlantError, match="without a task that ends, say for how many steps"):
        plant.record(lambda o: controls[0])
    with pytest.raises(PlantError, match="its task has no end"):
        plant.evaluate(lambda o: controls[:1], 2)


def test_a_vectorised_task_and_its_python_form_agree():
    model = Model.from_dm_control("hopper", "stand")
    fast, slow = find_task("hopper", "stand"), suite_task("hopper", "stand")
    assert isinstance(load_task("hopper", "stand"), VectorTask)
    assert (slow.control_timestep, slow.time_limit) == (fast.control_timestep, fast.time_limit)
    start = Start(np.array([0.0, -0.1, 0.0, 0.0, -0.7, 1.4, -0.7]))
    controls = np.random.default_rng(0).uniform(-1, 1, (40, 4))
    first, second = (Plant(model, task=t) for t in (fast, slow))
    a, b = (p.record(controls, start=start, warmstart=True) for p in (first, second))
    assert a.channels.keys() == b.channels.keys()
    for name, channel in a.channels.items():
        np.testing.assert_array_equal(channel.values, b.channels[name].values)
    assert first.trajectories[0].reward > 5
    assert first.trajectories[0].reward == pytest.approx(second.trajectories[0].reward, abs=1e-12)


def test_a_users_class_is_a_task():
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(Reach, model.compile())
    ours = make_environment(task, compiled(model, task), 3, seed=1, stagger=True)
    assert (ours.episode_steps, ours.observation_size, ours.action_size) == (10, 2, 2)
    ours.reset()
    steps = roll(ours, 10)
    assert [np.flatnonzero(s.truncated).tolist() for s in steps[:7]] == [
        [], [], [], [2], [], [], [1]
    ]  # fmt: skip
    returns = episode_returns(make_environment(task, compiled(model, task), 3), lambda o: 0 * o)
    assert (returns < 0).all()
    plant = Plant(model, task=task)
    recording = plant.record(lambda o: np.ones((1, 2)))
    assert recording.channels["qpos.wrist"].time[-1] == pytest.approx(0.4)
    assert plant.evaluate(lambda o: 0 * o, 2).shape == (2,)


def test_a_class_that_fails_when_it_is_made_is_not_made_without_its_seed():
    class Wrong(Reach):
        def __init__(self, random=None):
            super().__init__(random=random)
            if random is not None:
                raise TypeError("wrong in here")

    class Unseeded(Reach):
        def __init__(self):
            super().__init__(random=7)

    model = Model.from_dm_control("reacher", "easy").compile()
    with pytest.raises(TypeError, match="wrong in here"):
        class_task(Wrong, model).make(3)
    assert isinstance(class_task(Unseeded, model).make(3), Unseeded)
    assert class_task(Reach, model).make(3).random.randint(1000) == np.random.RandomState(
        3
    ).randint(1000)


def test_a_termination_ends_trajectory_and_episode():
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(Reach, model.compile())
    plant = Plant(model, task=task)
    fast = Start(np.zeros(2), np.array([20.0, 0.0]))
    assert len(plant.record(np.ones((10, 2)), start=fast).channels["qpos.wrist"].time) == 3
    environment = make_environment(task, compiled(model, task), 1)
    environment.reset()
    environment._machines[0].physics.data.qvel[0] = 20
    step = environment.step(np.ones((1, 2)))
    assert step.terminated[0]
    assert np.abs(step.observation - step.final).max() > 0


class Cut(Reach):
    """Ends after a tenth of a second, and would have gone on."""

    def get_termination(self, physics):
        return 1.0 if physics.data.time > 0.1 else None


def test_an_episode_that_is_cut_ends_and_is_no_termination():
    """dm_control ends episodes at any discount that is not None; one is that of a time limit."""
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(Cut, model.compile())
    environment = make_environment(task, compiled(model, task), 1)
    environment.reset()
    steps = roll(environment, 3)
    assert [bool(s.truncated[0]) for s in steps] == [False, False, True]
    assert not any(s.terminated[0] for s in steps)
    plant = Plant(model, task=class_task(Cut, model.compile()))
    assert plant.record(np.zeros((10, 2))).span[1] == pytest.approx(3 * Cut.control_timestep)


@pytest.mark.parametrize("domain_and_task", [("reacher", "easy"), ("hopper", "hop")])
def test_an_interrupted_environment_goes_on(domain_and_task):
    """The hopper's observations hold forces that the last step left behind."""
    task = suite_task(*domain_and_task)
    model = compiled(Model.from_dm_control(*domain_and_task), task)
    whole = PythonEnvironment(task, model, 2, seed=5)
    whole.reset()
    seen = roll(whole, 30)[-1].observation
    state = whole.get_state()
    expected = roll(whole, 30, seed=1)[-1]
    resumed = PythonEnvironment(task, model, 2, seed=5)
    np.testing.assert_array_equal(resumed.set_state(state), seen)
    np.testing.assert_array_equal(roll(resumed, 30, seed=1)[-1].observation, expected.observation)


class OwnGenerator(Reach):
    """A user's task that draws by a generator of its own, not by that of dm_control's suite."""

    def __init__(self, random):
        super().__init__()
        del self._random
        self.own, self.goal = np.random.default_rng(random), np.zeros(2)

    def initialize_episode(self, physics):
        physics.data.qpos[:] = self.own.uniform(-1, 1, 2)


def test_machines_of_a_task_with_a_generator_of_its_own_differ():
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(OwnGenerator, model.compile())
    task_model = compiled(model, task)
    first, second = (PythonEnvironment(task, task_model, 4, seed=3).reset() for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert len(np.unique(first, axis=0)) == 4


def test_a_task_with_a_generator_of_its_own_goes_on_with_its_draws():
    """A trajectory after an interruption began where the very first one had begun."""
    model = Model.from_dm_control("reacher", "easy")
    task = class_task(type("Short", (OwnGenerator,), {"time_limit": 0.1}), model.compile())
    task_model = compiled(model, task)
    machine, resumed = (PythonMachine(task, task_model, 3) for _ in range(2))
    starts = [machine.begin() for _ in range(3)]
    resumed.skip(2)
    np.testing.assert_array_equal(resumed.begin(), starts[2])
    for steps in (2, 17):  # within the first episode, and after some
        whole = PythonEnvironment(task, task_model, 2, seed=3)
        whole.reset()
        roll(whole, steps)
        state = whole.get_state()
        expected = [s.observation for s in roll(whole, 12, seed=1)]
        again = PythonEnvironment(task, task_model, 2, seed=3)
        again.reset()
        again.set_state(state)
        np.testing.assert_array_equal([s.observation for s in roll(again, 12, seed=1)], expected)


class OneAction(Reach):
    """A user's task with one action of a range of its own for two motors."""

    def action_spec(self, physics):
        return specs.BoundedArray((1,), float, [0.0], [20.0])

    def before_step(self, action, physics):
        assert action.shape == (1,)
        physics.data.ctrl[:] = [0.01 * action[0], -0.2 * action[0]]

    def get_termination(self, physics):
        return None


def test_a_task_is_excited_by_its_own_actions_and_commands_are_recorded_as_they_act():
    model = Model.from_dm_control("reacher", "easy")
    plant = Plant(model, task=class_task(OneAction, model.compile()))
    assert [e.tolist() for e in plant.command_range] == [[0.0], [20.0]]
    (recording,) = record(plant, model, 1, duration=0.4)
    first, second = (recording.channels[n].values for n in ("ctrl.shoulder", "ctrl.wrist"))
    assert first.min() >= 0
    assert np.ptp(first) > 0.05
    np.testing.assert_allclose(second, np.maximum(-20.0 * first, -1.0), atol=1e-12)
    assert second.min() == -1.0  # the end of its control range
    with pytest.raises(PlantError, match="must be S x 1"):
        plant.record(np.zeros((5, 2)))


def test_wrong_tasks_name_the_rule():
    with pytest.raises(StudyError, match="did you mean 'finger spin'"):
        load_task("finger", "spinn")
    model = Model.from_dm_control("reacher", "easy").compile()
    with pytest.raises(StudyError, match="class dict is no dm_control Task: it has no initialize"):
        class_task(dict, model)
    partly = type("Partly", (), {m: Reach.get_reward for m in dir(Reach) if "_step" not in m})
    with pytest.raises(StudyError, match="class Partly is no dm_control Task: it has no before_st"):
        class_task(partly, model)
    with pytest.raises(UserError, match="takes one model, not several"):
        make_environment(suite_task("finger", "spin"), [model], 1)
    with pytest.raises(PlantError, match=r"controls \(3, 1\) must be S x 2"):
        Plant(Model.from_dm_control("reacher", "easy"), task=class_task(Reach, model)).record(
            np.zeros((3, 1))
        )


@pytest.mark.parametrize("kind", [BatchEnvironment, PythonEnvironment])
def test_at_least_one_simulation(kind):
    task = (
        find_task("reacher", "easy") if kind is BatchEnvironment else suite_task("finger", "spin")
    )
    with pytest.raises(UserError, match="n is 0"):
        kind(task, Model.from_dm_control("reacher", "easy").compile(), 0)


class Faulty(Reach):
    """A user's task with a mistake, made after some steps."""

    method, mistake, after = "", None, 2

    def _do(self, method, right):
        if method != self.method:
            return right
        self.asked = getattr(self, "asked", 0) + 1
        return self.mistake() if self.asked > self.after else right

    def initialize_episode(self, physics):
        super().initialize_episode(physics)
        self._do("initialize_episode", None)

    def get_observation(self, physics):
        return self._do("get_observation", super().get_observation(physics))

    def get_reward(self, physics):
        return self._do("get_reward", super().get_reward(physics))

    def get_termination(self, physics):
        return self._do("get_termination", super().get_termination(physics))


def broken():
    raise KeyError("slidee")


@pytest.mark.parametrize(
    ("method", "mistake", "message"),
    [
        ("get_reward", broken, r"get_reward fails: KeyError: 'slidee' \(\w+\.py, line \d+\)"),
        ("get_reward", lambda: "high", "gave a reward of 'high'; it must be one number"),
        ("get_reward", lambda: np.ones(2), "gave a reward of array.*; it must be one number"),
        ("get_reward", lambda: np.nan, r"gave a reward of nan after 0\.\d+ s; it must be finite"),
        ("get_termination", lambda: sys.exit(3), r"get_termination fails: SystemExit: 3 \("),
        ("get_observation", broken, "get_observation fails: KeyError: 'slidee'"),
        ("get_observation", lambda: None, "get_observation returned None"),
        ("get_observation", lambda: ["high"], "get_observation fails: ValueError: could not"),
        ("get_observation", lambda: [0.0, np.nan], "number 1 of its observation is nan after 0"),
        ("get_observation", lambda: [1, 2, 3], "size 3 after one of size 2; it must keep its"),
        ("initialize_episode", broken, "initialize_episode fails: KeyError"),
    ],
)
def test_what_a_users_task_does_wrong_is_told_with_its_place(method, mistake, message):
    kind = type("Faulty", (Faulty,), {"method": method, "mistake": staticmethod(mistake)})
    model = Model.from_dm_control("reacher", "easy").compile(visuals=True)

    def run():
        environment = PythonEnvironment(class_task(kind, model), model, 2)
        environment.reset()
        roll(environment, 30)

    with pytest.raises(UserError, match=f"^task Faulty.*{message}"):
        run()


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"control_timestep": 0.003}, "control_timestep of 0.003 s; it must be a multiple of"),
        ({"control_timestep": -1}, "has a control_timestep of -1; it must be a time in"),
        ({"time_limit": "long"}, "has a time_limit of 'long'; it must be a time in"),
    ],
)
def test_times_of_a_users_task_that_are_none_are_told(attributes, message):
    model = Model.from_dm_control("reacher", "easy").compile()
    with pytest.raises(StudyError, match=message):
        class_task(type("Mine", (Reach,), attributes), model)


def test_an_argument_that_a_task_needs_is_told():
    class Needs(Reach):
        def __init__(self, target):
            self.target = target

    model = Model.from_dm_control("reacher", "easy").compile(visuals=True)
    with pytest.raises(UserError, match=r"task Needs: __init__ fails: TypeError: .* 'target'"):
        PythonEnvironment(class_task(Needs, model), model, 1)
