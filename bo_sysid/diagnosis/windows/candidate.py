"""An effect at a site as something that may be missing, and the study's parameters as the same."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, permutations, product

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects import Component, Effect, Extent, Machine, Site, applicable, extent_at
from bo_sysid.mjcf import Model, address_edit, nominal
from bo_sysid.mjcf.address import resolve
from bo_sysid.parameters import Parameter

_EXACT = 1e-6  # how far the magnitude of a discrete effect may lie from 1
_OFF = 2.0  # times the size of a magnitude that a start must have, to lead away from it
_DRY = "dry_friction"
PARAMETER = "parameter"  # id of the pseudo-effects that stand for the study's parameters


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a site, with its shapes fixed.

    Attributes:
        effect: the effect.
        site: where.
        extent: its bounds and probe there.
        point: the full magnitudes at which its signature is taken; the shapes are held here.
        secant: whether the signature is simulated there, because linearity does not reach so far.
        friction_joints: joints whose dry friction it is, where it stands for a parameter of the
            study.
        stage: when it is written among the study's parameters, see `mjcf.parameter_edits`.
        tied: whether it is one value for addresses that differ in the model, so that 0 is an edit.
        low: least values of the magnitudes that are fitted.
        high: their largest values.
        probe: magnitudes that move the predictions measurably.
    """

    effect: Effect
    site: Site
    extent: Extent
    point: Float[np.ndarray, " k"]
    secant: bool = False
    friction_joints: tuple[str, ...] = ()
    stage: int = 0
    tied: bool = False
    low: Float[np.ndarray, " l"] = field(init=False)
    high: Float[np.ndarray, " l"] = field(init=False)
    probe: Float[np.ndarray, " l"] = field(init=False)

    def __post_init__(self) -> None:
        for name in ("low", "high", "probe"):
            value = np.array(getattr(self.extent, name)[: self.size], float)
            object.__setattr__(self, name, value)
        if self.effect.discrete:
            object.__setattr__(self, "low", self.high * (1.0 - _EXACT))

    @property
    def size(self) -> int:
        """Number of magnitudes that are fitted."""
        return self.effect.linear

    @property
    def key(self) -> tuple[str, str]:
        """Effect and site; two candidates of one key exclude each other."""
        return self.effect.id, self.site.name

    @property
    def identity(self) -> tuple[object, ...]:
        """Everything that a fit of it hangs on, for `FitCache`."""
        components = tuple(c.name for c in self.effect.components)  # those of a learned law differ
        return (
            *self.key, components, self.site.kind, self.point, self.secant, self.friction_joints,
            self.low, self.high, self.probe,
        )  # fmt: skip

    @property
    def exclusive_keys(self) -> frozenset[tuple[str, str]]:
        """What no other candidate of a set can have: its key, the place of a joint that it adds."""
        return frozenset({self.key, *([("joint", self.site.name)] if self.effect.hidden else [])})

    @property
    def shapes(self) -> Float[np.ndarray, " s"]:
        """The shapes, held fixed."""
        return self.point[self.size :]

    @property
    def may_preslide(self) -> bool:
        """Whether it is friction that may give way before it slips, by its last shape."""
        return bool(self.extent.variants)

    @property
    def preslides(self) -> bool:
        """Whether that presliding is more than 0."""
        return self.may_preslide and bool(self.shapes[-1] > 0)

    @property
    def moved(self) -> bool:
        """Whether it is a load whose place is among its magnitudes."""
        return self.effect.placed > self.effect.shapes

    @property
    def free(self) -> "Candidate":
        """The same load with its place among the magnitudes."""
        e, n = self.extent, self.effect.acting
        extent = replace(e, probe=(*e.probe[:n], *(e.step for _ in e.place)), place=())
        return Candidate(self.effect.free, self.site, extent, np.array((*e.probe[:n], *e.place)))

    @property
    def without_presliding(self) -> "Candidate":
        """The same friction without presliding."""
        return self.with_shapes(np.array([*self.shapes[:-1], 0.0]))

    @property
    def regularised(self) -> bool:
        """Whether it is friction that neither holds, as it usually does, nor preslides."""
        switched = self.may_preslide and not self.extent.grid  # no speed is among its shapes
        return (
            switched and not self.preslides and not np.array_equal(self.shapes, self.usual.shapes)
        )

    @property
    def usual(self) -> "Candidate":
        """The same with the shapes that it usually has."""
        return self.with_shapes(np.array(self.extent.probe[self.size :], float))

    @property
    def is_dry_friction(self) -> bool:
        """Whether it is all dry friction of its joint, or holds that."""
        return _DRY in (self.effect.id, self.effect.nested)

    @property
    def points(self) -> list[Float[np.ndarray, " l"]]:
        """Magnitudes from which a fit is begun where one linearisation does not serve."""
        return [self.point[: self.size], *self.other_starts]

    @property
    def other_starts(self) -> list[Float[np.ndarray, " l"]]:
        """Further magnitudes from which a fit is begun, whatever is known of them."""
        return [s for s in self._starts if not np.isnan(s).any()]

    def off_saddles(self, x: Float[np.ndarray, " l"]) -> list[Float[np.ndarray, " l"]]:
        """Return magnitudes beside `x` to begin at, where no slope leads away from it."""
        found = []
        for start in self._starts:
            kept = np.isnan(start)
            if kept.any() and (np.abs(start) > _OFF * np.abs(x))[~kept].all():
                found.append(np.where(kept, x, start))
        return found

    @property
    def _starts(self) -> list[Float[np.ndarray, " l"]]:
        """The starts of the same shapes."""
        every = (np.array(s, float) for s in self.extent.starts)
        return [s[: self.size] for s in every if np.array_equal(s[self.size :], self.shapes)]

    def full(self, x: Float[np.ndarray, " l"]) -> Float[np.ndarray, " k"]:
        """Return magnitudes and shapes in one vector, as the effect takes them."""
        return np.concatenate([x, self.shapes])

    def total(self, x: Float[np.ndarray, " l"]) -> Float[np.ndarray, " l"]:
        """Return the magnitudes of all that a member is, for changes `x` of the model.

        Friction with presliding is all the friction of its joint, and its least change takes away
        what the model has. A load is its mass, where it lies.
        """
        if self.moved:
            return np.where(np.arange(self.size) < self.effect.acting, x, 0.0)
        return x - self.low if self.preslides else x

    def with_shapes(self, shapes: Float[np.ndarray, " s"]) -> "Candidate":
        """Return the same effect at the same site with other shapes."""
        point = np.concatenate([self.point[: self.size], shapes])
        return Candidate(self.effect, self.site, self.extent, point)

    def __str__(self) -> str:
        shapes = "".join(f" {s:.3g}" for s in self.shapes)
        return f"{self.effect.id}@{self.site.name}{shapes}"


def orders(members: Sequence[Candidate]) -> list[tuple[int, ...]]:
    """Return the other orders of members that act on one command in turn, as places in a set."""
    held: dict[str, list[int]] = {}
    for k, c in enumerate(members):
        if c.effect.in_turn:
            held.setdefault(c.site.name, []).append(k)
    found = []
    for changed in list(product(*(permutations(own) for own in held.values())))[1:]:
        order = list(range(len(members)))
        for own, other in zip(held.values(), changed, strict=True):
            for k, at in zip(own, other, strict=True):
                order[k] = at
        found.append(tuple(order))
    return found


def followed(members: Sequence[Candidate], k: int) -> bool:
    """Return whether another member acts on what a member makes of a command."""
    c = members[k]
    later = (d for d in members[k + 1 :] if d.effect.in_turn and d.site == c.site)
    return c.effect.in_turn and any(later)


def slices_of(held: Sequence[Candidate]) -> tuple[slice, ...]:
    """Return where each candidate stands in a vector of the magnitudes of all."""
    ends = list(accumulate((c.size for c in held), initial=0))
    return tuple(map(slice, ends[:-1], ends[1:]))


def candidates(effects: Sequence[Effect], machine: Machine) -> tuple[Candidate, ...]:
    """Return every effect at every site where it applies, once for each point of its grid."""
    found = []
    for effect in effects:
        if effect.family == "learned":
            continue
        for site in applicable(effect, machine):
            extent = extent_at(effect, site, machine)
            assert extent is not None  # noqa: S101 - applicable
            for point in extent.grid or (extent.probe,):
                found.append(Candidate(effect, site, extent, np.array(point, float)))
            for point in extent.secants:
                found.append(Candidate(effect, site, extent, np.array(point, float), secant=True))
    return tuple(found)


def parameter_candidates(model: Model, parameters: Sequence[Parameter]) -> tuple[Candidate, ...]:
    """Return the study's parameters as candidates whose magnitude is the change from the model."""
    return tuple(_parameter(model, p) for p in parameters)


def free_parameters(
    parameters: Sequence[Candidate], members: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """Return the parameters that are fitted beside some members.

    Friction that is a member is all there is at its joint: a parameter that is no more than the
    friction of such joints stays as in the model.
    """
    taken = {c.site.name for c in members if c.is_dry_friction}
    return tuple(
        p for p in parameters if not (p.friction_joints and taken.issuperset(p.friction_joints))
    )


def _parameter(model: Model, p: Parameter) -> Candidate:
    own, targets = nominal(model, p), [t for a in p.addresses for t in resolve(model, a)]
    dry = all((t.kind, t.name) == ("joint", "frictionloss") for t in targets)
    joints = tuple(t.element for t in targets) if dry else ()
    tied = p.apply == "set" and len({t.nominal for t in targets}) > 1

    def apply(
        spec: mujoco.MjSpec, site: Site, x: Float[np.ndarray, " k"], machine: Machine
    ) -> None:
        value = float(np.clip(own + x[0], min(p.low, own), max(p.high, own)))
        address_edit(model, p.addresses, value, p.apply)(spec)

    width = p.high - p.low  # bounds are opened by a trifle: the model's own value may be one
    low, high = min(p.low - own, -1e-9 * width), max(p.high - own, 1e-9 * width)
    extent = Extent((0.02 * width,), (low,), (high,))
    effect = Effect(
        id=PARAMETER, kind="world", components=(Component(p.name, p.unit),), apply=apply,
        extent=lambda s, m: extent, noun=p.name, sentence="", evidence="", separation="",
        nominal=lambda s, m: own,
    )  # fmt: skip
    at = Site("world", p.name)
    stage = max((t.stage for t in targets), default=0)
    return Candidate(
        effect, at, extent, np.array(extent.probe), friction_joints=joints, stage=stage, tied=tied
    )
