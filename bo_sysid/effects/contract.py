"""What an effect is: a kind of physics that a model can lack or have wrong.

An effect is one function ``apply(spec, site, x, machine)`` that edits an `MjSpec` by the
magnitudes `x` at a site. What MJCF cannot express it returns as parts (`parts.py`): a force that
is stepped with the simulation, a filter over a whole recorded input, another reading of a channel;
a joint that it adds it names. Magnitude 0 changes nothing. Everything else (its signature in the
predictions, its fit, its report) follows from the simulator.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Motion, Part, Signal

SiteKind = Literal["joint", "body", "geom", "actuator", "channel", "world"]
Family = Literal["physics", "sensing", "numerics", "learned"]
Magnitudes: TypeAlias = Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Site:
    """Where an effect acts: the kind and the name of an element of the model."""

    kind: SiteKind
    name: str

    def __str__(self) -> str:
        return self.name


Apply: TypeAlias = Callable[
    [mujoco.MjSpec, Site, Magnitudes, Machine], "Part | tuple[Part, ...] | None"
]


@dataclass(frozen=True)
class Component:
    """One element of an effect's magnitudes: a name and a unit for a hinge."""

    name: str
    unit: str


@dataclass(frozen=True)
class Extent:
    """How large an effect can be at one site, from the scale of the machine.

    Attributes:
        probe: a magnitude that moves the predictions measurably, element by element.
        low: lower bounds; nothing below is physical.
        high: upper bounds.
        grid: points at which the signature is taken where one linearisation does not serve
            (shapes such as a period or a speed, thresholds, delays); () means at the probe.
        starts: further magnitudes from which a fit is begun, where the probe lies on a saddle. NaN
            keeps what is known of a magnitude.
        refine: factors by which shapes are varied once the effect is in the leading set.
        secants: magnitudes so large that they change the motion, as a friction that holds a joint;
            the response to them is simulated, not linearised.
        variants: alternative shapes of friction, tried if the leading set leaves something
            unexplained. NaN keeps a shape. The last entry is the presliding displacement, 0 for
            none; where it is positive, `refine` varies it as well.
        place: where on its body a fit of the place begins, other than the usual one of the probe;
            () where the place is held.
        step: how far that fit looks around at first.
    """

    probe: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    grid: tuple[tuple[float, ...], ...] = ()
    starts: tuple[tuple[float, ...], ...] = ()
    refine: tuple[float, ...] = ()
    secants: tuple[tuple[float, ...], ...] = ()
    variants: tuple[tuple[float, ...], ...] = ()
    place: tuple[float, ...] = ()
    step: float = 0.0

    def __post_init__(self) -> None:
        named = {
            "probe": (self.probe,), "low": (self.low,), "high": (self.high,),
            "grid": self.grid, "starts": self.starts, "secants": self.secants,
        }  # fmt: skip
        for name, vectors in named.items():
            for v in vectors:
                if len(v) != len(self.probe):
                    raise ValueError(f"{name} {v} has another length than probe {self.probe}")
                known = [a for a in v if not (name == "starts" and math.isnan(a))]
                if not all(map(math.isfinite, known)) and name not in ("low", "high"):
                    raise ValueError(f"{name} {v} must be finite numbers")
        for low, high in zip(self.low, self.high, strict=True):
            if not low < high:
                raise ValueError(f"the bounds {low} and {high} are not in order")


@dataclass(frozen=True)
class Effect:
    """A kind of physics that a model can lack or have wrong.

    Attributes:
        id: name in studies and answers.
        kind: kind of site.
        components: the elements of the magnitudes, shapes last.
        apply: edits a spec, returns parts that MJCF cannot express.
        extent: bounds and probe at a site, None where the effect does not apply.
        noun: what it is called in a sentence, "dry friction".
        sentence: with the placeholders {site}, {value} and {interval}, those of its details, and
            {details} for their names.
        evidence: what gives it away in recordings.
        separation: which experiment separates it from what looks alike.
        shapes: how many of the last components are shapes, in which predictions are not linear.
        placed: how many of the last components are a place: shapes where it is held, magnitudes
            where it is fitted (`free`).
        vector: how many of the first components form a vector whose norm is the value.
        nominal: the quantity that the effect changes, as the model has it.
        family: which verdict a finding leads to.
        grouped: whether it can be missing on all sites at once, each with its own magnitude.
        weight: how many effects it counts as: a refinement, such as a difference between
            directions, counts as two.
        prior: relative prior probability; below 1 for an effect that recordings can hardly tell
            from a more common one, so that the common name is answered and this one beside it.
        threshold: whether it acts beyond a threshold only, so that a fit must begin at a point of
            the grid and not at the linear estimate.
        discrete: whether it is there or not, 1 or 0, and nothing between.
        nested: id of the simpler effect that remains where the first component is 0, if any.
        force: for an effect that is nothing but a force on its joint, that force as a law; its
            signature is then taken from the law, without stepping an edited model.
        details: from magnitudes to derived quantities worth telling, with their units there.
        absolute: the quantity itself, where that is reported instead of its change (the limit of
            a saturation, the time step).
        form: what it is in a model: MJCF attributes, or a force law, a filter, a reading.
        hidden: whether it adds a joint, whose coordinate no recording shows.
        in_turn: whether it changes a command so that it matters which of two such comes first: a
            dead zone of what a lag has smoothed is no lag of what passed a dead zone.
        of_drives: whether it is a law of what the actuators of its joint do, whatever else changes
            them.
        written: edits the spec of a model file, where plain MJCF can say what `apply` does with
            parts; like it, returns the parts that remain.
    """

    id: str
    kind: SiteKind
    components: tuple[Component, ...]
    apply: Apply
    extent: Callable[[Site, Machine], Extent | None]
    noun: str
    sentence: str
    evidence: str
    separation: str
    shapes: int = 0
    placed: int = 0
    vector: int = 1
    nominal: Callable[[Site, Machine], float] = lambda site, machine: 0.0
    family: Family = "physics"
    grouped: bool = False
    weight: int = 1
    prior: float = 1.0
    threshold: bool = False
    discrete: bool = False
    nested: str | None = None
    force: Callable[[Site, Magnitudes, Machine], Callable[[Motion], Signal]] | None = None
    details: Callable[[Magnitudes, Machine, Site], Mapping[str, tuple[float, str]]] | None = None
    absolute: Callable[[Magnitudes, Machine, Site], float] | None = None
    form: str = ""
    hidden: bool = False
    in_turn: bool = False
    of_drives: bool = False
    written: Apply | None = None

    @property
    def linear(self) -> int:
        """How many components are magnitudes, 0 of which changes nothing."""
        return len(self.components) - self.shapes

    @property
    def acting(self) -> int:
        """Number of components other than the place; the effect is absent where all are 0."""
        return len(self.components) - max(self.shapes, self.placed)

    @property
    def turn(self) -> int:
        """When it is edited in among others: laws of drives after what changes those, loops last.

        A joint that is added closes the loops of servos with the gains that others have changed.
        """
        return 2 if self.hidden else int(self.of_drives)

    @property
    def free(self) -> "Effect":
        """The same effect with its place among the magnitudes."""
        return replace(self, shapes=self.shapes - self.placed)

    @property
    def unit(self) -> str:
        """Unit of the value at a hinge."""
        return self.components[0].unit

    def parts(
        self, spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
    ) -> tuple[Part, ...]:
        """Edit `spec` by the magnitudes `x` and return what MJCF cannot express."""
        return self._made(self.apply, spec, site, x, machine)

    def write(
        self, spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
    ) -> tuple[Part, ...]:
        """Edit the spec of a model file and return what a plain MJCF file cannot express."""
        return self._made(self.written or self.apply, spec, site, x, machine)

    def _made(
        self, apply: Apply, spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
    ) -> tuple[Part, ...]:
        if not np.any(x[: self.acting]):
            return ()
        made = apply(spec, site, x, machine)
        if made is None:
            return ()
        return made if isinstance(made, tuple) else (made,)

    def reported(self, x: Magnitudes, machine: Machine, site: Site) -> float:
        """Return the value as answers have it: absolute where the effect says so."""
        return self.value(x) if self.absolute is None else self.absolute(x, machine, site)

    def value(self, x: Magnitudes) -> float:
        """Return the size of the change: the first component, or the norm of the vector."""
        if self.discrete:
            return float(np.round(x[0]))
        return float(x[0] if self.vector == 1 else np.linalg.norm(x[: self.vector]))
