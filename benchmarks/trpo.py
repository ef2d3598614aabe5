"""TRPO against sb3-contrib's on Gymnasium's HalfCheetah, and collection against the bare engine.

Speed: control steps per second of whole iterations, both packages in turn in one run, with equal
settings (20 000 steps a batch, 10 critic epochs of batches of 128). Returns: mean reward of the
last 100 000 steps before 500 k and 1 M steps times the length of an episode, as the ratio of
interquartile means over seeds with a bootstrap interval. Collection: control steps per second of a
batch with a random policy as a fraction of `mj_step` along the same controls; the steps for which
cheetahs settle before an episode are physics steps of the collection, too.

    python benchmarks/trpo.py [--quick] [--stored]
"""

import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from common import Cases, benchmark
from threadpoolctl import threadpool_limits

from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment
from bo_sysid.plants.tasks import find_task
from bo_sysid.policy.network import GaussianPolicy
from bo_sysid.policy.normalisation import Normaliser, RunningMoments
from bo_sysid.policy.rollout import collect
from bo_sysid.policy.trainer import Trainer

NAME, BATCH, KL = "HalfCheetah-v5", 20_000, 0.02
ENVIRONMENTS = 80  # ours, in lock-step; sb3-contrib has 8, with which it was measured fastest
SUITE = {
    "cheetah": ("cheetah", "run"),
    "hopper": ("hopper", "stand"),
    "swimmer": ("swimmer", "swimmer3"),
}
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


def gymnasium_model() -> mujoco.MjModel:
    """Return the model of Gymnasium's HalfCheetah."""
    from gymnasium.envs import mujoco as environments

    file = find_task("gymnasium", NAME).kind.file
    return Model.from_file(Path(environments.__file__).parent / "assets" / file).compile()


def ours(seed: int, threads: int) -> Iterator[float]:
    """Yield the batch return of one iteration after the other."""
    environment = BatchEnvironment(
        find_task("gymnasium", NAME),
        gymnasium_model(),
        ENVIRONMENTS,
        seed=seed,
        threads=threads,
        stagger=True,
    )
    trainer = Trainer(environment, seed=seed, threads=threads)
    while True:
        yield trainer.iterate().batch_return


def theirs(seed: int) -> Iterator[float]:
    """Yield the batch return of one iteration of sb3-contrib after the other."""
    import sb3_contrib
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    class Rewards(BaseCallback):
        """Collects the rewards before they are normalised."""

        def _on_rollout_start(self) -> None:
            self.rewards: list[float] = []

        def _on_step(self) -> bool:
            self.rewards.append(float(self.training_env.get_original_reward().mean()))
            return True

    environment = VecNormalize(make_vec_env(NAME, n_envs=8, seed=seed))
    model = sb3_contrib.TRPO(
        "MlpPolicy", environment, n_steps=BATCH // 8, target_kl=KL, seed=seed, device="cpu"
    )
    while True:
        rewards = Rewards()
        model.learn(BATCH, callback=rewards, reset_num_timesteps=False)
        yield 1000 * float(np.mean(rewards.rewards))


def speed(threads: int, repeats: int) -> dict[str, float]:
    """Return steps per second of both and the ratio, measured in turn A B A."""
    torch.set_num_threads(threads)
    own, other = ours(0, threads), theirs(0)

    def steps_per_second(side: Iterator[float], iterations: int) -> float:
        started = time.perf_counter()
        for _ in range(iterations):
            next(side)
        return iterations * BATCH / (time.perf_counter() - started)

    rows = []
    for side in (own, other):
        next(side)
    for _ in range(repeats):
        first, peer = steps_per_second(own, 2), steps_per_second(other, 1)
        rows.append((2 / (1 / first + 1 / steps_per_second(own, 2)), peer))
    mine, peers = np.array(rows).T
    return {
        "ours": float(np.median(mine)),
        "sb3": float(np.median(peers)),
        "ratio": float(np.median(mine / peers)),
    }


def returns(side: Iterator[float], quick: bool) -> list[float]:
    """Return the mean batch return of the 100 k steps before 500 k and before 1 M steps."""
    torch.set_num_threads(1)
    marks = [2, 4] if quick else [25, 50]
    curve = [next(side) for _ in range(marks[-1])]
    return [float(np.mean(curve[max(mark - 5, 0) : mark])) for mark in marks]


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the middle half of the last axis."""
    ordered = np.sort(values, axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def ratio(own: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """Return the ratio of interquartile means, and its 95 % bootstrap interval over seeds."""
    rng = np.random.default_rng(0)
    drawn = [
        interquartile_mean(x[rng.integers(len(x), size=(10_000, len(x)))]) for x in (own, other)
    ]
    low, high = np.quantile(drawn[0] / drawn[1], [0.025, 0.975])
    return {
        "ours": float(interquartile_mean(own)),
        "sb3": float(interquartile_mean(other)),
        "ratio": float(interquartile_mean(own) / interquartile_mean(other)),
        "low": float(low),
        "high": float(high),
    }


def collection(robot: str, repeats: int) -> float:
    """Return the median fraction of the engine's own speed that a collection reaches."""
    task = find_task(*SUITE[robot])
    model = Model.from_dm_control(*SUITE[robot]).compile()
    environment = BatchEnvironment(task, model, ENVIRONMENTS, stagger=True)
    observation = environment.reset()
    policy = GaussianPolicy.of_size(environment.observation_size, environment.action_size, (64, 64))
    theta = policy.initial(np.random.default_rng(0))
    normaliser = Normaliser.of(RunningMoments.of_size(environment.observation_size))
    steps = BATCH // ENVIRONMENTS
    settling = task.settle_time / task.control_timestep * ENVIRONMENTS * steps
    settling /= environment.episode_steps
    fractions = []
    for k in range(repeats):
        before = environment.sims.state.copy()
        started = time.perf_counter()
        rollout, observation = collect(
            environment, observation, policy, theta, normaliser, steps, np.random.default_rng(k)
        )
        speed = (BATCH + settling) / (time.perf_counter() - started)
        controls = environment.controls(rollout.actions)
        fractions.append(speed / raw_speed(model, before, controls, environment.substeps))
    return float(np.median(fractions))


def raw_speed(
    model: mujoco.MjModel, starts: np.ndarray, controls: np.ndarray, substeps: int
) -> float:
    """Return control steps per second of `mj_step` alone along eight of the trajectories."""
    data, done = mujoco.MjData(model), 0
    started = time.perf_counter()
    for i in range(0, len(starts), len(starts) // 8):
        mujoco.mj_setState(model, data, starts[i], STATE)
        for control in controls[:, i]:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, substeps)
        done += len(controls)
    return done / (time.perf_counter() - started)


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Measure speed, collection, and returns, or take what is there."""
    warnings.simplefilter("ignore")
    repeats, seeds = (2, 2) if quick else (7, 8)

    def found(key: str, compute: Callable[[], Any]) -> Any:
        return None if cases.stored and key not in cases else cases.get(key, compute)

    speeds = {t: found(f"speed {t}", partial(speed, t, repeats)) for t in (1, 2)}
    with threadpool_limits(1):
        fractions = {
            r: found(f"collection {r}", partial(collection, r, 3 * repeats)) for r in SUITE
        }
    pairs = []
    for seed in range(seeds):  # both sides of a seed in turn: what there is, is paired
        own = found(f"returns {seed}", lambda s=seed: returns(ours(s, 1), quick))
        other = found(f"returns sb3 {seed}", lambda s=seed: returns(theirs(s), quick))
        if own is not None and other is not None:
            pairs.append((own, other))
    figures: dict[str, Any] = {
        **{f"speed_{t}": s["ratio"] for t, s in speeds.items() if s is not None},
        "collection": {r: f for r, f in fractions.items() if f is not None},
        "details": {"speed": speeds, "seeds_of_returns": len(pairs)},
    }
    for k, mark in enumerate(("500k", "1m") if pairs else ()):
        told = ratio(np.array([p[0][k] for p in pairs]), np.array([p[1][k] for p in pairs]))
        figures[f"return_{mark}"] = told["ratio"]
        figures["details"][f"returns_{mark}"] = told
    return figures


if __name__ == "__main__":
    benchmark("trpo", run, partial=True)
