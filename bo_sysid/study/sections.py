"""The sections of a study file about the model, the recordings and the search (DESIGN.md)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, PlainSerializer, field_validator, model_validator

from bo_sysid.study.base import (
    CodePath,
    Count,
    FilePath,
    Name,
    Names,
    NotNegative,
    Paths,
    Positive,
    Real,
    Section,
    Seed,
)


class DmControl(Section):
    """A task of the dm_control suite."""

    domain: Name
    """Domain of the suite, such as cheetah."""
    task: Name
    """Task of the domain, such as run."""


class ModelSource(Section):
    """Where the model comes from: exactly one of `file`, `dm_control` and `menagerie`."""

    file: FilePath | None = None
    """MJCF (or URDF) file, relative to the study file."""
    dm_control: DmControl | None = None
    """The model of a task of the dm_control suite."""
    menagerie: Name | None = None
    """Name of a robot in $BO_SYSID_MENAGERIE."""
    base: Literal["model", "fixed"] = "model"
    """model: the base moves as the MJCF says; fixed: a floating base is held."""

    @model_validator(mode="after")
    def _one(self) -> Self:
        _exactly_one(self, "file", "dm_control", "menagerie")
        return self


class Column(Section):
    """How a channel is read from a column of the log."""

    source: Annotated[Name | None, Field(alias="from")] = None
    """Name of the column in the log; the channel's own name where left out."""
    unit: str | None = None
    """Unit in the log (deg, mm, ms, …); converted to the model's."""
    sign: Literal[-1, 1] = 1
    """-1 turns the direction round."""
    scale: Real = 1.0
    """Factor on the values of the log, after the unit."""
    offset: Real = 0.0
    """Added to the values after unit, sign and scale, in the model's unit."""
    unwrap: bool = False
    """Remove jumps of a full turn."""


class Clock(Section):
    """The time stamps of a kind of channel, or of one channel."""

    source: Annotated[Name, Field(alias="from")] = "time"
    """Name of the column with the time stamps."""
    hold: Literal["none", "zero"] | None = None
    """zero: a value applies until the next stamp; none: it was measured at the stamp."""


class Recordings(Section):
    """Recordings of the real machine: `train` (and `holdout`), or `dataset`."""

    train: Paths | None = None
    """Files (globs) that the model is fitted to."""
    holdout: Paths | None = None
    """Files (globs) that are read only after the answer is frozen."""
    dataset: Name | None = None
    """A public dataset with its default split, instead of files."""
    columns: Mapping[str, Column] = {}
    """How channels are read, where names, units or signs differ from the convention."""
    clocks: Mapping[str, Clock] = {}
    """Time stamps by kind of channel (qpos, ctrl, …) or by channel."""
    noise: Mapping[str, Positive] = {}
    """Standard deviation by kind of channel or by channel, in its unit; estimated otherwise."""

    @field_validator("columns", mode="before")
    @classmethod
    def _short_columns(cls, value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        return {k: {"from": v} if isinstance(v, str) else v for k, v in value.items()}

    @model_validator(mode="after")
    def _one(self) -> Self:
        _exactly_one(self, "train", "dataset")
        if self.dataset is not None and self.holdout is not None:
            raise ValueError("dataset brings its own holdout; leave holdout out")
        return self


class ActuatorLaw(Section):
    """What an actuator does that MJCF cannot say."""

    law: CodePath
    """<file>.py:<function> that turns goals, predicted state and auxiliary channels into ctrl."""
    uses: tuple[Name, ...] = ()
    """Channels handed to the law, such as aux.voltage."""


class ParameterEntry(Section):
    """A physical quantity of the model that is uncertain."""

    address: Names
    """MJCF address or addresses, such as geom[forearm].mass; several are tied."""
    low: Real
    """Lower bound, in `unit`."""
    high: Real
    """Upper bound, in `unit`."""
    name: Name | None = None
    """Name in tables and figures; the address where left out."""
    apply: Literal["set", "scale", "add"] = "set"
    """set writes the value, scale multiplies the model's own, add adds to it."""
    each: bool = False
    """One parameter per match of the address; else the matches are tied."""
    steps: Annotated[Count, Field(ge=2)] = 11
    """Number of grid values from low to high."""
    unit: str = ""
    """Unit of the value."""

    @model_validator(mode="after")
    def _extent(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        return self


class Deviation(Section):
    """How far a model's predictions are from what was recorded."""

    horizon: Count = 1
    """Number of recorded instants predicted from each start."""
    starts: Literal["measured", "fitted"] = "measured"
    """measured: start at the recorded state; fitted: the start of each window is a nuisance."""
    whiten: Literal["auto"] | Mapping[str, Positive] = "auto"
    """auto, or the scale of each kind of channel or channel, in its unit."""


class Candidates(Section):
    """The discrete set B: a full grid, or so many points of a Sobol design."""

    sobol: Count | None = None
    """Number of points of a scrambled Sobol sequence; a full grid where left out."""


def _write_candidates(value: Candidates) -> str | dict[str, int]:
    return "grid" if value.sobol is None else {"sobol": value.sobol}


def _candidates(value: Any) -> Any:
    if isinstance(value, str):
        if value != "grid":
            raise ValueError(f"must be grid or {{sobol: <number>}}, not {value!r}")
        return {}
    return value


class Stop(Section):
    """When the search stops before its budget is used."""

    entropy: NotNegative = 0.01
    """Stop when the entropy of P fell by less than this (in nats) …"""
    last: Count = 5
    """… over so many evaluations."""


class Search(Section):
    """The search for the arg-min of the deviation over the candidates."""

    candidates: Annotated[
        Candidates,
        BeforeValidator(_candidates, json_schema_input_type=Literal["grid"] | Candidates),
        PlainSerializer(_write_candidates),
    ] = Candidates()
    """grid, or {sobol: number of points}."""
    refine: bool = False
    """Zoom into a new discrete set around the mass of P."""
    acquisition: Name = "argmin-entropy"
    """Which candidate is tried next."""
    budget: Count = 60
    """Most evaluations of the deviation."""
    stop: Stop = Stop()
    """When the search stops earlier."""
    seed: Seed = 0
    """Seed of everything drawn at random."""


def _exactly_one(section: Section, *keys: str) -> None:
    given = [k for k in keys if getattr(section, k) is not None]
    if len(given) != 1:
        found = " and ".join(given) if given else "none"
        raise ValueError(f"needs exactly one of {', '.join(keys)}; found {found}")
