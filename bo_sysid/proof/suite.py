"""A suite: what is drawn, how large, how often, and on which machines; one YAML file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from bo_sysid.proof import (  # noqa: F401 - importing registers what is concealed
    other_sites,
    outside_catalogue,
)
from bo_sysid.proof.draft import REALISED, find_realised
from bo_sysid.proof.machine import ProofMachine, load_machine
from bo_sysid.study.base import Count, Name, Paths, Positive, Section, Seed
from bo_sysid.study.messages import study_error
from bo_sysid.study.source import Source, matching, read

LEAST_NOTHING = 0.25
"""Least share of cases that conceal nothing."""

TIERS = (2, 3, 4)
Share = Annotated[float, Field(ge=0, le=1)]


class Seconds(Section):
    """Length of the recordings."""

    train: Positive = 20.0
    """Of the recording that a diagnosis sees, in s."""
    holdout: Positive = 8.0
    """Of the recording that it is judged on, in s."""


class Suite(Section):
    """What is drawn; the answers that were drawn are not in it."""

    version: Literal[1] = 1
    """Version of the format of suites."""
    name: str = ""
    """What the suite is for."""
    seed: Seed | None = None
    """Only for development, where the answers may be known; drawn by the system otherwise."""
    cases: Count
    """Number of cases."""
    nothing: Annotated[float, Field(ge=LEAST_NOTHING, le=1)] = 0.3
    """Share of the cases that conceal nothing."""
    parameters: Share = 0.33
    """Share of the cases in which parameters of the study are off their nominal values."""
    pairs: Share = 0.2
    """Among the cases of tiers 2 and 3 that conceal something, the share that conceals two."""
    groups: Share = 0.1
    """Among them, the share that conceals one kind on all joints, each with its own magnitude."""
    tiers: Mapping[int, Share] = {2: 0.4, 3: 0.4, 4: 0.2}
    """Weight of each tier: 2 MuJoCo with another step, 3 equations of motion, 4 outsiders."""
    machines: Paths
    """Files of machines, relative to the suite."""
    effects: Literal["all"] | tuple[Name, ...] = "all"
    """all, or the ids of what is concealed."""
    sizes: tuple[Positive, Positive] = (1.0, 30.0)
    """Range of sizes in sensor sigma, drawn log-uniform."""
    noise: tuple[Positive, Positive] = (3e-4, 1e-3)
    """Range of the sensors' sigma in rad or m, drawn log-uniform."""
    seconds: Seconds = Seconds()
    """Length of the recordings."""

    @model_validator(mode="after")
    def _ranges(self) -> "Suite":
        for key in ("sizes", "noise"):
            low, high = getattr(self, key)
            if not low < high:
                raise ValueError(f"{key}: {low:g} must be below {high:g}")
        if not self.tiers or set(self.tiers) - set(TIERS) or not sum(self.tiers.values()):
            raise ValueError(f"tiers: weights of {', '.join(map(str, TIERS))}, not all zero")
        if self.pairs + self.groups > 1:
            raise ValueError("pairs and groups: together at most 1")
        return self


@dataclass(frozen=True)
class LoadedSuite:
    """A suite with its machines.

    Attributes:
        suite: what the file says.
        machines: by name.
    """

    suite: Suite
    machines: Mapping[str, ProofMachine]

    def ids(self, tier: int) -> tuple[str, ...]:
        """Return what can be concealed in a tier on at least one machine."""
        wanted = list(REALISED) if self.suite.effects == "all" else list(self.suite.effects)
        return tuple(i for i in wanted if tier in REALISED[i].tiers and self.fitting(i, tier))

    def fitting(self, id: str, tier: int) -> tuple[str, ...]:
        """Return the machines on which something can be concealed in a tier."""
        item = REALISED[id]
        return tuple(n for n, m in self.machines.items() if tier in m.tiers and item.sites(m))


def load_suite(path: str | Path, overrides: Mapping[str, Any] | None = None) -> LoadedSuite:
    """Read a suite and its machines.

    Args:
        path: the YAML file.
        overrides: values by key that replace what the file says.

    Raises:
        StudyError: the suite or a machine is wrong.
        ModelError: a machine's model is.
    """
    path = Path(path)
    source = read(path, overrides or {})
    try:
        suite = Suite.model_validate({"name": path.stem, **source.data})
    except ValidationError as error:
        raise study_error(error, source, Suite) from None
    if suite.effects != "all":
        for id in suite.effects:
            find_realised(id)
    return LoadedSuite(suite, MappingProxyType(_machines(suite, path.parent, source)))


def _machines(suite: Suite, folder: Path, source: Source) -> dict[str, ProofMachine]:
    found: dict[str, ProofMachine] = {}
    for i, pattern in enumerate(suite.machines):
        files = matching(folder, pattern)
        if not files:
            raise source.error(("machines", i), f"{pattern!r} matches no file in {folder}")
        for file in files:
            machine = load_machine(file)
            if machine.name in found:
                raise source.error(("machines", i), f"there are two machines {machine.name!r}")
            found[machine.name] = machine
    return found
