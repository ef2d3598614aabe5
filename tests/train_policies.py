"""Train the small policies under which tasks are compared with dm_control: a few minutes.

    python tests/train_policies.py

They only have to move in ways that random actions do not: run, stand, swing up, reach. Weights are
stored without pickle, a few KB each.
"""

from pathlib import Path

from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import BatchEnvironment
from bo_sysid.plants.repeat import RepeatedTask
from bo_sysid.plants.tasks import find_task
from bo_sysid.policy.settings import TrpoSettings, TrustRegion
from bo_sysid.policy.train import train

FOLDER = Path(__file__).parent / "policies"
TASKS = {  # how long an action is held in training, actions
    ("cartpole", "balance"): (2, 50_000),
    ("cartpole", "swingup"): (2, 250_000),
    ("cheetah", "run"): (4, 100_000),
    ("hopper", "hop"): (4, 250_000),
    ("hopper", "stand"): (4, 200_000),
    ("pendulum", "swingup"): (2, 200_000),
    ("reacher", "easy"): (2, 150_000),
    ("walker", "walk"): (4, 100_000),
}


def main() -> None:
    """Train and store a policy for each task."""
    for (domain, name), (repeat, steps) in TASKS.items():
        task = RepeatedTask(find_task(domain, name), repeat)
        model = Model.from_dm_control(domain, name).compile()
        environment = BatchEnvironment(task, model, 50, seed=0, stagger=True)
        settings = TrpoSettings(
            batch=5_000, discount=0.98, hidden=(16, 16), region=TrustRegion(kl=0.04)
        )
        training = train(environment, settings, steps=steps, seed=0)
        training.policy.save(FOLDER / f"{domain}-{name}.npz")
        print(domain, name, f"{training.log['batch_return'].iloc[-5:].mean():.0f}", flush=True)


if __name__ == "__main__":
    main()
