"""The sections of a study file about the model, the recordings and the search."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

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
    base: Literal["free", "fixed"] = "free"
    """fixed: a floating base is held where the file puts it."""
    beside: tuple[FilePath, ...] = ()
    """Files with forces, filters and readings that MJCF cannot express, as diagnose writes them."""
    hold: tuple[Name, ...] = ()
    """Joints held where the file puts them, as those that were not recorded."""
    unrecorded: Mapping[Name, Name | None] = {}
    """Joints that move though nothing measures them, each with the joint whose encoder shows it as
    well (play that the encoder on a link sees), or null: its start is fitted, or follows from the
    others where the model's equalities close a chain."""

    @model_validator(mode="after")
    def _one(self) -> "ModelSource":
        _exactly_one(self, "file", "dm_control", "menagerie")
        if self.dm_control is not None and self.hold:
            raise ValueError("hold goes with file or menagerie; a task of dm_control moves whole")
        if self.dm_control is not None and self.unrecorded:
            raise ValueError("unrecorded goes with file or menagerie")
        return self


class Column(Section):
    """How a channel is read: sign · unwrap(scale · factor(unit) · signed(column)) + offset.

    What the column shows of another channel is taken off then (`less`).
    """

    source: Annotated[Name | None, Field(alias="from")] = None
    """Name of the column in the log; the channel's own name where left out."""
    unit: Name | None = None
    """Unit in the log (deg, mm, ms, …); SI, or what the file says, where left out."""
    sign: Literal[1, -1] = 1
    """-1 turns the direction round."""
    scale: Real = 1.0
    """Factor beside the unit's own; for encoder ticks the SI value of one tick."""
    offset: Real = 0.0
    """Added last, in SI units."""
    unwrap: bool | Positive = False
    """true for an angle that jumps by a turn, or the size of the jump in SI units (of time: s)."""
    signed: Literal[0, 8, 16, 32] = 0
    """Bits of an unsigned integer that holds a signed one, as the registers of servos do."""
    hold: Literal["none", "zero", "linear"] | None = None
    """zero: a value applies until the next stamp; linear: an input that changes all the time was
    sampled (a measured duty or current); none: it was measured at the stamp."""
    clock: Name | None = None
    """Name of the column with the time stamps, in s."""
    missing: Literal["error", "skip"] = "error"
    """skip: an empty cell holds no new sample."""
    less: Name | None = None
    """Channel that the column shows as well, as an encoder does that counts from the base."""
    rate: NotNegative = 0.0
    """Of time alone, where no column has the time stamps: steady rows per second, in Hz."""


class Clock(Section):
    """The time stamps of a kind of channel, or of one channel."""

    source: Annotated[Name | None, Field(alias="from")] = None
    """Name of the column with the time stamps; the recording's own where left out."""
    unit: Name | None = None
    """Unit of that column; s, or what the file says, where left out."""
    hold: Literal["none", "zero", "linear"] | None = None
    """zero: a value applies until the next stamp; linear: an input that changes all the time was
    sampled (a measured duty or current); none: it was measured at the stamp."""
    shift: Real = 0.0
    """Added to the stamps, in s: how much later than stamped the channels happened."""


def _short(value: Any) -> Any:
    return {"from": value} if isinstance(value, str) else value


class Recordings(Section):
    """Recordings of the real machine: `train` (and `holdout`), or `dataset`."""

    train: Paths | None = None
    """Files (globs) that the model is fitted to."""
    holdout: Paths | None = None
    """Files (globs) read only after the answer is frozen; the last quarter by time otherwise."""
    dataset: Name | None = None
    """A public dataset with its default split, instead of files."""
    columns: Mapping[
        str, Annotated[Column, BeforeValidator(_short, json_schema_input_type=str | Column)]
    ] = {}
    """How channels are read, where names, units or signs differ from the convention."""
    clocks: Mapping[
        str, Annotated[Clock, BeforeValidator(_short, json_schema_input_type=str | Clock)]
    ] = {}
    """Time stamps by kind of channel (qpos, ctrl, …) or by channel."""
    noise: Mapping[str, Positive] = {}
    """Standard deviation by kind of channel or by channel, in its unit; estimated otherwise."""

    @model_validator(mode="after")
    def _one(self) -> "Recordings":
        _exactly_one(self, "train", "dataset")
        own = [k for k in ("holdout", "columns", "clocks") if getattr(self, k)]
        if self.dataset is not None and own:
            raise ValueError(f"dataset brings its own {own[0]}; leave {own[0]} out")
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
    """Lower bound, in SI units: rad, m, kg, N m."""
    high: Real
    """Upper bound, in SI units."""
    name: Name | None = None
    """Name in tables and figures; the address where left out."""
    apply: Literal["set", "scale", "add"] = "set"
    """set writes the value, scale multiplies the model's own, add adds to it."""
    each: bool = False
    """One parameter per match of the address; else the matches are tied."""
    steps: Count = 11
    """Number of grid values from low to high, at least 2."""
    ordered: bool | None = None
    """false: the grid values are categories without an order, such as numbers of variants."""
    unit: str = ""
    """Unit of the value in tables and figures, an SI unit; nothing is converted."""

    @model_validator(mode="after")
    def _extent(self) -> "ParameterEntry":
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.steps < 2:
            raise ValueError(f"steps is {self.steps}; at least 2")
        return self


class Deviation(Section):
    """How far a model's predictions are from what was recorded."""

    horizon: Count = 1
    """Number of recorded instants predicted from each start."""
    starts: Literal["measured", "fitted"] = "measured"
    """measured: start at the recorded state, whose noise moves parameters (damping above all);
    fitted: the start of each window is a nuisance. Where no velocity was recorded, or not when most
    positions were, starts are fitted in any case, in windows of 0.15 s or more."""
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
    """Stop when the entropy of P changed by less than this (in nats) …"""
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
    """Zoom into a new discrete set around the mass of P, until the recordings tell no more."""
    acquisition: Name = "max-value-entropy"
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
