"""Gymnasium's tasks against Gymnasium's own."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment
from bo_sysid.plants.tasks import find_task, registered

gymnasium = pytest.importorskip("gymnasium", reason="the peers' packages are not installed")
pytest.importorskip("imageio", reason="Gymnasium's MuJoCo environments are not installed")

NAMES = [name for domain, name in registered() if domain == "gymnasium"]


def assets():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from gymnasium.envs import mujoco as environments
    return Path(environments.__file__).parent / "assets"


@pytest.mark.parametrize("name", NAMES)
def test_steps_equal_gymnasiums(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other = gymnasium.make(name).unwrapped
    task = find_task("gymnasium", name)
    model = Model.from_file(assets() / task.kind.file).compile()
    ours = BatchEnvironment(task, model, 1)
    assert ours.episode_steps == 1000
    rng = np.random.default_rng(0)
    other.reset(seed=4)
    ended = 0
    for episode in range(3):
        start = task.draw_start(model, np.random.default_rng(episode))
        other.np_random = np.random.default_rng(episode)
        first = other.reset_model()
        np.testing.assert_allclose(ours.begin([start])[0], first, rtol=0, atol=1e-14)
        for _ in range(300):
            action = np.clip(0.5 * rng.standard_normal(ours.action_size), -1, 1)
            observation, reward, terminated, _, _ = other.step(action)
            step = ours.step(action[None])
            np.testing.assert_allclose(step.final[0], observation, rtol=0, atol=1e-9)
            np.testing.assert_allclose(step.reward[0], reward, rtol=0, atol=1e-9)
            assert step.terminated[0] == terminated
            if terminated:
                ended += 1
                break
    assert ended == (3 if "Hopper" in name else 0)
