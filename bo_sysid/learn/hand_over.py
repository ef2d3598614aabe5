"""A policy for a person's machine: a file to run there, and what to record."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Point
from bo_sysid.errors import StudyError
from bo_sysid.intervals import upper_bound
from bo_sysid.learn.scene import Scene
from bo_sysid.mjcf import Model
from bo_sysid.plants.environment import control_range
from bo_sysid.plants.limits import LimitedTask
from bo_sysid.plants.load import compiled
from bo_sysid.plants.machine import command_ends
from bo_sysid.plants.python_environment import PythonMachine
from bo_sysid.plants.python_task import PythonTask, suite_task
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.runs import Run, atomic
from bo_sysid.study.sections import Column

_EPISODES = 60  # none of them beyond limits: fewer than 5 % are, with 95 % confidence
_LIMITS_SEED = 2_000_003  # their starts are none of those of training


def command_range(scene: Scene) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """Return the lowest and the highest command of every actuator, limits included.

    Returns:
        `a` commands at the actions -1 and `a` at the actions 1, in the actuators' units (those of
        MuJoCo's `ctrl`).
    """
    model = scene.compiled(scene.candidates.points[0])
    if isinstance(scene.task, PythonTask):
        return command_ends(PythonMachine(scene.task, model, 0))
    return control_range(model)


def machine_names(scene: Scene) -> dict[str, list[str]]:
    """Return the names of the joints and actuators that a policy was learned with."""
    return {"joints": list(scene.model.joints), "actuators": list(scene.model.controlled)}


def write_commands(scene: Scene, policy: LearnedPolicy, path: Path) -> None:
    """Write the policy as a TorchScript module from observations to commands.

    It maps `n x o` float32 observations to `n x nu` commands in the actuators' units, clipped to
    their range and the study's limits; it runs wherever libtorch does, without this package.
    """
    from bo_sysid.learn.commands import write_module

    low, high = command_range(scene)
    with atomic(path) as place:
        write_module(policy, low, high, place)


def observed(scene: Scene) -> tuple[str, ...]:
    """Return the names of a task's observations in order, none where the task does not name them.

    An entry of several numbers has their count behind its name.
    """
    task = scene.task
    if isinstance(task, PythonTask):
        machine = PythonMachine(task, scene.compiled(scene.candidates.points[0]), 0)
        machine.begin()
        return machine.observed
    study = scene.study
    named = (study.model if study.task is None else study.task).dm_control
    if named is None:
        return ()
    try:
        theirs = suite_task(named.domain, named.task)
    except StudyError:  # a task of this package alone
        return ()
    model = Model.from_dm_control(named.domain, named.task)
    machine = PythonMachine(theirs, compiled(model, theirs), 0)
    machine.begin()
    return machine.observed


def beyond_limits(
    scene: Scene, policy: LearnedPolicy, point: Point
) -> dict[str, float | int] | None:
    """Return in how many simulated episodes the policy leaves the study's limits.

    Args:
        scene: task and limits.
        policy: what acts.
        point: `d` parameter values of the model that it acts on.

    Returns:
        "episodes", their "share" from 0 to 1, and what that is "at_most" with 95 % confidence; None
        where the study has no limits.
    """
    if not isinstance(scene.task, LimitedTask):
        return None
    task = copy(scene.task)
    scene = replace(scene, task=task)
    seed = scene.seed + _LIMITS_SEED
    environment = scene.environment(scene.compiled(point), _EPISODES, seed=seed)
    observation = environment.reset()
    running, left = np.ones(_EPISODES, bool), np.zeros(_EPISODES, bool)
    while running.any():
        step = environment.step(policy.act(observation))
        left |= running & task.beyond
        running &= ~(step.terminated | step.truncated)
        observation = step.observation
    share, most = float(left.mean()), upper_bound(int(left.sum()), _EPISODES)
    return {"episodes": _EPISODES, "share": share, "at_most": most}


def write_for_machine(scene: Scene, policy: LearnedPolicy, run: Run, name: str) -> dict[str, Any]:
    """Write a policy as a module, ``<name>.pt``, and what it takes and gives, ``<name>.json``."""
    write_commands(scene, policy, run.path(f"{name}.pt"))
    low, high = command_range(scene)
    seconds, beyond = scene.task.time_limit, policy.about.get("beyond_limits") or {}
    about = {
        "observations": policy.policy.network.sizes[0],
        "observed": list(observed(scene)),
        "actuators": list(scene.model.controlled),
        "low": low.tolist(),
        "high": high.tolist(),
        "control_timestep": scene.task.control_timestep,
        "seconds": seconds if np.isfinite(seconds) else None,
        "simulated_episodes": beyond.get("episodes"),
        "simulated_share_beyond_limits": beyond.get("share"),
        "simulated_share_at_most": beyond.get("at_most"),
    }
    run.write_json(f"{name}.json", about)
    return about


def how_to_run(about: Mapping[str, Any]) -> str:
    """Return what a module takes and gives, in words, from its JSON file."""
    return (
        f"The module takes the {_observations(about)} of the task every "
        f"{about['control_timestep']:g} s and gives the commands of "
        f"{', '.join(about['actuators'])}, clipped to {_ranges(about['low'], about['high'])}."
    )


def cautions(about: Mapping[str, Any]) -> list[str]:
    """Return how often a policy left the study's limits in simulation, where there are limits."""
    share, episodes = about["simulated_share_beyond_limits"], about["simulated_episodes"]
    if share is None:
        return []
    stop = "Clipping commands cannot prevent that: have the machine stop by itself."
    if share:
        return [
            f"CAUTION: in {share:.0%} of {episodes} simulated episodes this policy leaves the "
            f"limits of position or velocity. {stop}"
        ]
    return [
        f"In none of {episodes} simulated episodes does this policy leave the limits of position "
        f"or velocity. {stop}"
    ]


def hand_over(scene: Scene, run: Run, policy: LearnedPolicy, number: int, stem: str) -> str:
    """Write policy `number` for the machine, and return what to record and where to put it."""
    name = f"policies/policy-{number:02d}"
    about = write_for_machine(scene, policy, run, name)
    (run.path(stem).parent).mkdir(exist_ok=True)
    return "\n".join(
        [
            f"waiting for recording {number}: run {run.path(name)}.pt on the machine and put what "
            f"it did into {run.path(stem)}.parquet (or .csv, .npz, .mat).",
            f"- {how_to_run(about)}",
            f"- Record {_length(about)}: {_columns(scene)}; velocities where there are some.",
            *[f"- {caution}" for caution in cautions(about)],
            "Then give the same command again; it goes on from there.",
        ]
    )


def _observations(about: Mapping[str, Any]) -> str:
    words, names = f"{about['observations']} observations", ", ".join(about["observed"])
    return f"{words} ({names}, in this order)" if names else words


def _columns(scene: Scene) -> str:
    """Return what to record: channels, by column and unit where the study has rules for them."""
    model, rules = scene.model, scene.study.recordings.columns
    if not rules:
        return f"time, qpos.<joint> of every joint, {', '.join(model.ctrl_channels)}"
    shown = [n for n in model.qpos_channels if n.removeprefix("qpos.") not in model.unrecorded]
    names = dict.fromkeys(["time", *shown, *model.ctrl_channels, *rules])
    columns = ", ".join(_column(name, rules.get(name)) for name in names)
    return f"{columns}, as under recordings.columns of the study, which is applied to the file"


def _column(channel: str, rule: Column | None) -> str:
    if rule is None:
        return channel
    unit = f" in {rule.unit}" if rule.unit else ""
    return f"{rule.source!r}{unit} ({channel})" if rule.source else f"{channel}{unit}"


def _length(about: Mapping[str, Any]) -> str:
    seconds, often = about["seconds"], f"every {about['control_timestep']:g} s or more often"
    return f"an episode of {seconds:g} s, {often}" if seconds else f"as long as is safe, {often}"


def _ranges(low: Sequence[float], high: Sequence[float]) -> str:
    return ", ".join(f"[{a:g}, {b:g}]" for a, b in zip(low, high, strict=True))
