"""What a repaired model has beside its MJCF file: forces, filters and readings, kept as data.

The file names effects of the catalogue with their magnitudes, and learned laws with the weights of
their terms; the scales that both refer to are in it. Nothing in it is code.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from bo_sysid.arrays import Times
from bo_sysid.effects.contract import Effect, Site
from bo_sysid.effects.learned import features, learned_force
from bo_sysid.effects.machine import ActuatorScale, BodyScale, ChannelScale, JointScale, Machine
from bo_sysid.effects.parts import Filter, Force, Part, Reading
from bo_sysid.effects.readings import readings
from bo_sysid.effects.registry import CATALOGUE
from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import GAP
from bo_sysid.runs import atomic

_VERSION = 4


@dataclass(frozen=True)
class Placed:
    """An effect of the catalogue at a site, with all its magnitudes."""

    effect: str
    site: Site
    x: tuple[float, ...]


@dataclass(frozen=True)
class LearnedLaw:
    """A learned force on a joint.

    Attributes:
        joint: its name.
        weights: of each term by its name.
        hold: time in [s] for which a value may be held, the step at which it was learned.
    """

    joint: str
    weights: Mapping[str, float]
    hold: float = 0.0


@dataclass(frozen=True)
class Beside:
    """What stands beside a model file.

    Attributes:
        machine: the scales that the magnitudes refer to.
        effects: of the catalogue.
        laws: learned forces.
        source: where this was read from, for messages.
    """

    machine: Machine
    effects: tuple[Placed, ...] = ()
    laws: tuple[LearnedLaw, ...] = ()
    source: str = "beside the model"

    def parts(self, model: Model, effects: Mapping[str, Effect] = CATALOGUE) -> tuple[Part, ...]:
        """Return what is stepped, filtered and read beside a model.

        Args:
            model: with the edits in it.
            effects: all that there are, by id.

        Raises:
            ModelError: an effect, a site or a term is not known or not in the model, or magnitudes
                are missing.
        """
        made = [part for placed in self.effects for part in self._placed(model, placed, effects)]
        return (*made, *(self._force(model, law) for law in self.laws))

    def _placed(
        self, model: Model, placed: Placed, effects: Mapping[str, Effect]
    ) -> tuple[Part, ...]:
        effect, site = effects[self._known("effect", placed.effect, effects)], placed.site
        self._known("kind of site", site.kind, (effect.kind,))
        self._known(site.kind, site.name, self.machine.names(site.kind))
        self._in_model(model, site.kind, site.name)
        if len(placed.x) != len(effect.components):
            raise ModelError(
                f"{self.source}: {effect.id} at {site} has {len(placed.x)} magnitudes; it needs "
                + ", ".join(c.name for c in effect.components)
            )
        x = np.array(placed.x)
        # edits are in the model's file already: copies are thrown away
        remaining = beside_a_file(effect.write(model.spec(), site, x, self.machine))
        # what is listed stands beside the file: where a file could say it, this one does not, since
        # something follows it or the step was another
        return remaining or effect.parts(model.spec(), site, x, self.machine)

    def _force(self, model: Model, law: LearnedLaw) -> Force:
        joint = self._known("joint", law.joint, self.machine.joints)
        self._in_model(model, "joint", joint)
        terms = {t.name: t for t in features(joint, self.machine)}
        for name, weight in law.weights.items():
            read = terms[self._known(f"term of a law on {joint}", name, terms)].of.name
            group, _, element = read.partition(".")
            if weight and group in _READ:  # a term of time reads nothing of the model
                self._in_model(model, _READ[group], element)
        weights = np.array([law.weights.get(n, 0.0) for n in terms])
        scale = self.machine.joints[joint].force
        return Force(joint, learned_force(tuple(terms.values()), weights, scale), law.hold)

    def _known(self, what: str, name: str, valid: Collection[str]) -> str:
        if name not in valid:
            raise ModelError(f"{self.source}: unknown {what} {name!r}; {nearest(name, valid)}")
        return name

    def _in_model(self, model: Model, kind: str, name: str) -> None:
        """Require that the model has what the file names; the file may be another model's."""
        valid = _names(model, kind)
        if name not in valid:
            hint = nearest(name, valid) or "it has none at all"
            raise ModelError(
                f"{self.source}: the model {model.source} has no {kind} {name!r}; "
                f"{hint}{'' if hint.endswith('?') else '.'} Name the file that was written with "
                f"this model, or rename the {kind} in the model or everywhere in the file"
            )

    def write(self, path: Path) -> None:
        """Write the file that `read_beside` reads."""
        m = self.machine
        content = {
            "version": _VERSION,
            "effects": [
                {"effect": e.effect, "kind": e.site.kind, "site": e.site.name, "x": list(e.x)}
                for e in self.effects
            ],
            "laws": [
                {"joint": w.joint, "weights": dict(w.weights), "hold": w.hold} for w in self.laws
            ],
            "machine": {
                **{name: {k: asdict(v) for k, v in getattr(m, name).items()} for name in _TABLES},
                "channels": list(m.channels),
                "timestep": m.timestep,
                "sampling": m.sampling,
                "duration": m.duration,
            },
        }
        with atomic(path) as unfinished:
            unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _names(model: Model, kind: str) -> tuple[str, ...]:
    """Return the names of a model's sites of one kind."""
    return {
        "joint": model.joints,
        "actuator": model.actuators,
        "body": model.bodies,
        "geom": model.geoms,
        "channel": model.shown_channels,
        "world": ("world",),
    }[kind]


_READ = {"qpos": "joint", "qvel": "joint", "ctrl": "actuator", "load": "actuator"}
"""By what the variable of a learned law's term begins with, the kind of what it is read from."""

_TABLES: Mapping[str, type[Any]] = {
    "joints": JointScale,
    "actuators": ActuatorScale,
    "bodies": BodyScale,
    "scales": ChannelScale,
}


def read_beside(path: Path, model: mujoco.MjModel) -> Beside:
    """Read what stands beside a model.

    Args:
        path: a file that `Beside.write` wrote.
        model: the compiled model.

    Raises:
        ModelError: the file is none of these.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["version"] != _VERSION:
            raise ModelError(f"{path}: version {content['version']}; this one reads {_VERSION}")
        stored = content["machine"]
        tables: dict[str, Any] = {
            name: MappingProxyType({k: _scale(made, v) for k, v in stored[name].items()})
            for name, made in _TABLES.items()
        }
        machine = Machine(
            model=model, timestep=float(stored["timestep"]), channels=tuple(stored["channels"]),
            sampling=float(stored["sampling"]), duration=float(stored["duration"]), **tables,
        )  # fmt: skip
        effects = tuple(
            Placed(e["effect"], Site(e["kind"], e["site"]), tuple(map(float, e["x"])))
            for e in content["effects"]
        )
        laws = tuple(
            LearnedLaw(
                w["joint"],
                {n: float(v) for n, v in w["weights"].items()},
                float(w.get("hold", 0.0)),
            )
            for w in content["laws"]
        )
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(
            f"{path}: is no file of what stands beside a model, as diagnose writes it "
            f"({type(error).__name__}: {error})"
        ) from None
    return Beside(machine, effects, laws, str(path))


def beside_a_file(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Return the parts that a model file cannot say."""
    return tuple(p for p in parts if isinstance(p, Force | Filter | Reading))


def _scale(made: Callable[..., Any], scale: Mapping[str, Any]) -> Any:
    return made(**{k: tuple(v) if isinstance(v, list) else v for k, v in scale.items()})


def as_commanded_and_measured(
    recording: Recording, parts: Sequence[Part], timestep: float
) -> Recording:
    """Return a recording as the model is to see it: controls filtered, readings undone.

    A reading shows (1 + scale)·p(t - delay) + offset of a quantity p; p itself is returned. Where
    positions are not all equally late, what is late keeps its stamps and p is interpolated there,
    so that a simulation can begin at stamps that all positions share; a note says so.

    Args:
        recording: as the machine told it.
        parts: what stands beside the model; forces are left to the simulation.
        timestep: of the simulation in [s], to which filters are exact.
    """
    channels, notes = dict(recording.channels), list(recording.notes)
    for p in parts:
        if isinstance(p, Filter) and f"ctrl.{p.actuator}" in channels:
            name = f"ctrl.{p.actuator}"
            channels[name] = p.change(channels[name], timestep)
    read = {c: r for c, r in readings(parts).items() if c in recording.channels}
    positions = [c for c in recording.channels if c.startswith("qpos.")]
    delays = {read[c].delay if c in read else 0.0 for c in positions}
    for r in read.values():
        shown = recording.channels[r.channel]
        made = replace(
            shown, time=shown.time - r.delay, values=(shown.values - r.offset) / (1.0 + r.scale)
        )
        if r.delay and delays - {r.delay}:
            made = _interpolated(made, shown.time)
            notes.append(
                f"{r.channel} reads {r.delay:.3g} s late: what it shows was interpolated to the "
                "stamps at which it was recorded"
            )
        channels[r.source or r.channel] = made
    return replace(recording, channels=channels, notes=tuple(notes))


def _interpolated(channel: Channel, time: Times) -> Channel:
    """Return a channel at other stamps, by a cubic spline; none in a gap or beyond its ends."""
    after = np.searchsorted(channel.time, time)
    inside = (after > 0) & (after < len(channel.time))
    intervals = np.diff(channel.time)
    across = intervals[np.clip(after - 1, 0, len(intervals) - 1)]
    time = time[inside & (across <= GAP * np.median(intervals))]
    return replace(channel, time=time, values=CubicSpline(channel.time, channel.values)(time))
