"""The sections of a study file about diagnosis, learning, comparison and plants."""

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from bo_sysid.study.base import (
    Count,
    FilePath,
    Name,
    NotNegative,
    Paths,
    Positive,
    Real,
    Section,
    Several,
)
from bo_sysid.study.sections import DmControl

_DAY = 86_400.0  # [s]


def _address(value: str) -> str:
    if not re.fullmatch(r"\w+(\[.+\])?\.\w+(\[\d+\])?", value.strip()):
        raise ValueError(
            'must be the address of a number of the model, such as "body[base].mass", not '
            f"{value!r}; effects are left out with exclude"
        )
    return value


class Diagnosis(Section):
    """Which missing physics is looked for."""

    effects: Literal["all"] | tuple[Name, ...] = "all"
    """all, or the ids of the effects to consider (`bo-sysid effects` lists them)."""
    exclude: tuple[Name, ...] = ()
    """Ids of effects to leave out."""
    known: tuple[Annotated[Name, AfterValidator(_address)], ...] = ()
    """MJCF addresses whose values are certain."""
    most: Count = 3
    """Most findings at once; a group counts as one."""
    effect_files: tuple[FilePath, ...] = ()
    """Python files that register effects of your own."""


class Limit(Section):
    """Bounds that every excitation or policy meant for the machine keeps."""

    position: tuple[Real, Real] | None = None
    """Lowest and highest position, in rad or m."""
    velocity: Positive | None = None
    """Highest speed, in rad/s or m/s."""
    effort: Positive | None = None
    """Highest torque or force, in N m or N."""

    @field_validator("position")
    @classmethod
    def _extent(cls, position: tuple[float, float] | None) -> tuple[float, float] | None:
        if position is not None and not position[0] < position[1]:
            raise ValueError(f"low {position[0]:g} must be below high {position[1]:g}")
        return position


class Task(Section):
    """What a policy is learned for: a task of dm_control or a class in a file."""

    dm_control: DmControl | None = None
    """A task of the dm_control suite."""
    file: FilePath | None = None
    """Python file with a dm_control Task."""
    class_name: Annotated[Name | None, Field(alias="class")] = None
    """Name of the class in `file`."""
    repeat: Count = 1
    """Control steps of a dm_control task that an action is held for, their rewards added up; the
    task is then controlled, and its steps are counted, at this slower rate."""

    @model_validator(mode="after")
    def _one(self) -> "Task":
        if (self.dm_control is None) == (self.file is None):
            raise ValueError("needs either dm_control or file with class")
        if (self.file is None) != (self.class_name is None):
            raise ValueError("file and class go together")
        if self.file is not None and self.repeat > 1:
            raise ValueError("repeat goes with dm_control; a class says its control_timestep")
        return self


class Policy(Section):
    """How a policy is learned."""

    algorithm: Literal["trpo"] = "trpo"
    """Learning algorithm."""
    batch: Several = 20_000
    """Simulated control steps per iteration, at least 2."""
    steps: Count = 1_000_000
    """Simulated control steps that a policy is learned with, rounded up to whole batches."""
    draft: Count | None = None
    """Simulated control steps of policies that cannot be the last, because argmax P is farther than
    epsilon from their candidate or the rule waits for the time out; as many as `steps` where left
    out. The last policy always has `steps`."""
    start: Literal["fresh", "warm"] = "fresh"
    """fresh: every policy begins anew; warm: it goes on from the one before, on the new model."""
    episode: Positive | None = None
    """Length of the episodes of training in s, at least one control step, where shorter ones give
    more starts to learn from; their ends are bootstrapped like any time limit. The task's where
    left out."""
    kl: Positive = 0.02
    """Bound of the KL divergence of an update, averaged over action dimensions."""
    discount: Annotated[float, Field(gt=0, le=1)] = 0.99
    """Discount of rewards per control step."""
    decay: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Decay (lambda) of generalised advantage estimation per control step."""
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (64, 64)
    """Units of the hidden layers."""

    @model_validator(mode="after")
    def _shorter(self) -> "Policy":
        if self.draft is not None and self.draft > self.steps:
            raise ValueError(f"draft: {self.draft} must not be more than steps, {self.steps}")
        return self


class Learn(Section):
    """The outer loop: roll out, identify, choose a model, learn a policy on it."""

    choose: Name = "sample"
    """How the model for the policy is chosen from P."""
    stop: Name = "seed"
    """Rule that ends the outer loop."""
    epsilon: Positive = 0.05
    """seed: distance, in shares of the bounds, at which two candidates count as one; zhu: largest
    expected difference of value, relative."""
    r: Positive = 0.05
    """Largest relative difference of value between neighbouring candidates at the end."""
    eta: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Least probability of a candidate that the stop rule zhu asks for its value."""
    trajectories: Count = 10
    """Most trajectories of the real machine."""
    episodes: Count = 20
    """Simulated episodes by which a policy is valued on each model, and on a simulated plant."""
    models: Literal["chosen", "bootstrap"] = "chosen"
    """What a policy is learned on: the chosen candidate, or a draw from P_boot every episode."""
    diagnose: Literal["auto", "never"] = "auto"
    """auto: call the diagnosis when no candidate explains the recordings."""


class Arm(Section):
    """One way of searching, in a comparison; what is left out is as the study has it."""

    name: Name | None = None
    """Name in tables and figures; what the arm is made of where left out."""
    acquisition: Name | None = None
    """Which candidate is tried next; `search.acquisition` where left out."""
    choose: Name | None = None
    """How the model for the policy is chosen from P; `learn.choose` where left out."""
    stop: Name | None = None
    """Rule that ends the outer loop; `learn.stop` where left out."""
    seeds: Count | None = None
    """So many of the paired seeds alone, for an arm that takes long; all where left out."""


def _arm(value: Any) -> Any:
    return {"acquisition": value} if isinstance(value, str) else value


class Compare(Section):
    """Arms compared on this study, and on others, with paired seeds."""

    arms: tuple[
        Annotated[Arm, BeforeValidator(_arm, json_schema_input_type=str | Arm)],
        ...,
    ] = ()
    """The arms; a text is the name of an acquisition. The others are compared with the first."""
    seeds: Count = 30
    """Number of paired seeds."""
    problems: Paths | None = None
    """Further studies on which the same arms are compared, with their own search and plant."""
    loop: Literal["inner", "outer"] = "inner"
    """inner: searches on recordings; outer: learn, with the arm's choice of model and stop rule."""
    truth: Literal["drawn", "stated"] = "drawn"
    """drawn: every seed has a plant with parameters of its own within the bounds; stated: as the
    study says."""
    regrets: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.1, 0.01, 0.0)
    """Levels of regret whose cost is told. inner: excess of Δ over its minimum on B, in shares of
    the median excess; outer: shortfall of the return, in shares of the best."""
    table: Count = 20_000
    """Where B has at most so many candidates Δ is computed on all of B once for each seed, and
    the searches look it up."""


class Execution(Section):
    """Where jobs run."""

    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine; ray: a Ray cluster."""
    address: Name | None = None
    """Address of the Ray cluster; auto finds a running one, left out one is started here."""

    @model_validator(mode="after")
    def _ray(self) -> "Execution":
        if self.address is not None and self.engine != "ray":
            raise ValueError("address needs engine: ray")
        return self


class PlantEffect(Section):
    """An effect that the plant has and the model lacks."""

    effect: Name
    """Id of the effect."""
    kind: Literal["joint", "body", "geom", "actuator", "channel", "world"] = "world"
    """Kind of site."""
    site: Name | None = None
    """Name of the site; left out for the world."""
    value: Real
    """Magnitude, in the effect's unit."""
    details: Mapping[str, Real] = {}
    """Further components by name."""


class Record(Section):
    """What `bo-sysid record` records of the plant."""

    train: Count = 3
    """Number of training recordings."""
    holdout: Count = 1
    """Number of recordings that are set aside."""
    seconds: Annotated[Positive, Field(le=_DAY)] = 5.0
    """Length of each, in s."""
    excitation: Literal["random", "multisine"] = "random"
    """Controls that move the plant: random with a correlation time, or sums of sines."""
    warmstart: bool = False
    """Also record the solver's warm start, so that the true parameters predict exactly."""


class Plant(Section):
    """A simulated machine to record from: what it has is hidden from every other command."""

    parameters: Mapping[str, Real] = {}
    """True value by the name of a parameter of the study."""
    effects: tuple[PlantEffect, ...] = ()
    """Effects that the plant has."""
    noise: Mapping[str, NotNegative] = {}
    """Standard deviation of the noise by kind of channel or by channel, in its unit."""
    timestep: Positive | None = None
    """Time step of the plant in s; the model's where left out."""
    record: Record = Record()
    """What `bo-sysid record` records."""
