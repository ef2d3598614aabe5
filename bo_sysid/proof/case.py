"""Draw one case: a plant with something concealed, its recordings, and the answer.

Frozen by commit before any threshold of the diagnosis is tuned; see `plan`.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bo_sysid.errors import StudyError
from bo_sysid.mjcf import parameter_edits
from bo_sysid.mjcf.joints import SLIDE
from bo_sysid.parameters import Parameter
from bo_sysid.proof.adaptive import AdaptivePlant
from bo_sysid.proof.draft import REALISED, Draft, Place, Realised, Scales, drive_force
from bo_sysid.proof.equations import EQUATIONS
from bo_sysid.proof.joints import log_uniform
from bo_sysid.proof.machine import MotionCommand, ProofMachine, rounded
from bo_sysid.proof.physics import Concealed, Physics
from bo_sysid.proof.plan import Draw
from bo_sysid.proof.rolled import PlantDiverged, Rolled
from bo_sysid.proof.size import CONTACT_HORIZON, HORIZON, Reference
from bo_sysid.proof.stepped import Integrator, SteppedPlant, Stepping
from bo_sysid.proof.suite import LoadedSuite
from bo_sysid.recording import Recording

_PROBE = 8.0  # [s] of motion on which a magnitude is set
_ATTEMPTS = 12  # sites, magnitudes and motions that are tried before a case is given up
_STEPS = 7  # of the search for a magnitude
_NEAR = 0.15  # of the logarithm of a size
_UNEVEN = (0.6, 1.6)  # of the sizes within a group
_LEEWAY = 0.7  # of the range of sizes, for the whole recording
_AMPLITUDES = (1.0, 0.7, 0.5, 0.35)  # shares of the machine's motion, until it keeps its limits
_QUANTA = (0.1, 1.0)  # resolution of tier 2's encoders, in sigma
_FINE, _FINE_SERVO = Stepping(2, "RK4"), Stepping(8, "RK4")  # a servo's fast pole needs it
_SMOOTH: tuple[tuple[int, Integrator], ...] = (
    (8, "Euler"), (8, "implicit"), (10, "implicitfast"), (16, "implicitfast"), (8, "RK4"),
)  # fmt: skip
_SERVO: tuple[tuple[int, Integrator], ...] = ((10, "implicit"), (16, "implicitfast"), (16, "RK4"))
_CONTACT: tuple[tuple[int, Integrator], ...] = ((4, "implicitfast"), (4, "Euler"), (6, "implicit"))


class NoCase(StudyError):  # noqa: N818 - told to whoever draws
    """No magnitude at any site gave the size that was asked for."""


@dataclass(frozen=True)
class Case:
    """A drawn case.

    Attributes:
        draw: what it was drawn from.
        recordings: by part, "train" and "holdout".
        parameters: what the study lists as uncertain.
        truth: the answer, for JSON.
    """

    draw: Draw
    recordings: dict[str, Recording]
    parameters: tuple[Parameter, ...]
    truth: dict[str, Any]


def draw_case(draw: Draw, loaded: LoadedSuite) -> Case:
    """Draw a case.

    Where sizes cannot be reached (a joint that is held moves no less under more friction), all is
    drawn anew, from a range of sizes whose upper end comes down from attempt to attempt.

    Raises:
        NoCase: what the draw asks for cannot be had on its machine.
    """
    machine = loaded.machines[draw.machine]
    rng = np.random.default_rng(draw.seed)
    low, high = loaded.suite.sizes
    for k in range(_ATTEMPTS):
        most = high * (2.0 * low / high) ** (k / (_ATTEMPTS - 1)) if high > 2.0 * low else high
        try:
            return _Attempt(draw, loaded, machine, rng, (low, most)).case()
        except (PlantDiverged, _Unreachable):
            continue
    raise NoCase(f"{draw.name}: nothing drawn for it could be sized")


class _Unreachable(Exception):  # noqa: N818 - another site or motion is tried
    """A size cannot be reached at this site."""


class _Attempt:
    """One attempt at a case; everything it draws comes from one generator."""

    def __init__(
        self,
        draw: Draw,
        loaded: LoadedSuite,
        machine: ProofMachine,
        rng: np.random.Generator,
        sizes: tuple[float, float],
    ) -> None:
        self._sizes = sizes
        self._draw, self._suite, self._machine, self._rng = draw, loaded.suite, machine, rng
        self._dt = machine.file.timestep
        self._servo = bool(np.any(machine.compiled.actuator_biasprm[:, 1]))
        self._sigma = log_uniform(rng, *self._suite.noise)
        self._quantum = 0.0
        self._adaptive = draw.tier == 3 or (draw.tier == 4 and machine.file.equations is not None)
        self._stepping = self._step_like()
        if not self._adaptive:
            self._quantum = self._sigma * log_uniform(rng, *_QUANTA)
        self._parameters, self._values = self._off()
        edits = parameter_edits(machine.model, self._parameters, self._values)
        self._true = machine.model.compile(edits)
        self._seeds = {part: int(rng.integers(2**62)) for part in ("train", "holdout")}
        self._amplitude = _AMPLITUDES[0]

    def case(self) -> Case:
        """Return the case."""
        plain = Draft.begin(self._machine, self._true).finished()
        for amplitude in _AMPLITUDES:
            self._amplitude = amplitude
            probe = self._roll(self._stepped(plain), "train", self._suite.seconds.train)
            if self._within(probe):
                break
        scales = Scales.of(plain, probe)
        found = self._found(scales)
        physics = self._physics([c for c, _ in found])
        rolls = {
            part: self._roll(self._plant(physics), part, getattr(self._suite.seconds, part))
            for part in ("train", "holdout")
        }
        total = self._reference().size(rolls["train"], self._noise_vector())
        self._require_size(total, len(found))
        final = [(self._ended(c, physics, rolls["train"]), size) for c, size in found]
        if len(final) == 1:
            final = [(final[0][0], total)]
        recordings = {part: self._recording(part, r) for part, r in rolls.items()}
        return Case(self._draw, recordings, self._parameters, self._truth(final, total))

    def _step_like(self) -> Stepping:
        """Draw the step of a plant in MuJoCo."""
        machine = self._machine
        choices = _CONTACT if machine.file.contact else _SERVO if self._servo else _SMOOTH
        return Stepping(*choices[int(self._rng.integers(len(choices)))])

    def _off(self) -> tuple[tuple[Parameter, ...], list[float]]:
        """Draw the true values of the parameters that the study lists."""
        if not self._draw.parameters:
            return (), []
        entries = self._machine.file.parameters
        chosen = entries[int(self._rng.integers(len(entries)))]
        parameter = Parameter(
            chosen.name or chosen.address[0], chosen.address, chosen.low, chosen.high,
            chosen.steps, chosen.apply, chosen.unit,
        )  # fmt: skip
        return (parameter,), [float(self._rng.uniform(chosen.low, chosen.high))]

    def _found(self, scales: Scales) -> list[tuple[Concealed, float]]:
        """Draw where each effect is and how large, log-uniform; return them with their sizes.

        A group shares out one size among its sites, unevenly.
        """
        rng, found = self._rng, []
        for id in self._draw.effects:
            item, size = REALISED[id], log_uniform(rng, *self._sizes)
            sites = [s for s in item.sites(self._machine) if not self._listed(id, s)]
            if not sites:
                raise _Unreachable(f"{id} anywhere")
            if not self._draw.grouped:
                found.append(self._sized(item, str(rng.choice(sites)), scales, size))
                continue
            for site in sites:
                share = size / np.sqrt(len(sites)) * log_uniform(rng, *_UNEVEN)
                found.append(self._sized(item, site, scales, share))
        return found

    def _listed(self, id: str, site: str) -> bool:
        """Whether a parameter of the study is what would be concealed: nothing would be missing."""
        addresses = [a for p in self._parameters for a in p.addresses]
        return id == "link_mass" and site in self._machine.bodies_of_masses(addresses)

    def _require_size(self, total: float, count: int) -> None:
        """Refuse a case whose size is far from what was asked for, as where motion differs."""
        low, high = self._suite.sizes
        if count and not _LEEWAY * low <= total <= high * count / _LEEWAY:
            raise _Unreachable(f"the whole recording shows a size of {total:g}")

    def _sized(
        self, item: Realised, site: str, scales: Scales, target: float
    ) -> tuple[Concealed, float]:
        """Return an effect at a magnitude that gives a size, and the size that it gives."""
        place = Place(self._machine, scales, site)
        most = item.most(place)
        concealed = item.draw(self._rng, place)
        if abs(concealed.value) > most:
            concealed = item.scaled(concealed, 0.5 * most / abs(concealed.value))
        last = (0.0, 0.0)
        for _ in range(_STEPS):
            size = self._probe(concealed)
            if abs(np.log(size / target)) < _NEAR:
                return concealed, size
            slope = _slope(last, (abs(concealed.value), size))
            last = (abs(concealed.value), size)
            factor = float(np.clip((target / size) ** (1.0 / slope), 0.05, 20.0))
            room = most / abs(concealed.value)
            if factor > room and room < 1.01:  # as large as it can be here
                if size < min(self._suite.sizes[0], target):
                    break
                return concealed, size
            concealed = item.scaled(concealed, min(factor, room))
        raise _Unreachable(f"{item.id} at {site}")

    def _probe(self, concealed: Concealed) -> float:
        """Return the size of an effect alone on the first seconds; large where it diverges."""
        physics = self._physics([concealed])
        plant = self._plant(physics) if physics.transmission else self._stepped(physics)
        seconds = min(_PROBE, self._suite.seconds.train)
        try:
            rolled = self._roll(plant, "train", seconds)
        except PlantDiverged:
            return 30.0 * self._suite.sizes[1]
        return max(self._reference().size(rolled, self._noise_vector()), 1e-6)

    def _physics(self, concealed: Sequence[Concealed]) -> Physics:
        draft = Draft.begin(self._machine, self._true)
        for c in concealed:
            REALISED[c.effect].compose(draft, c)
        return draft.finished()

    def _plant(self, physics: Physics) -> AdaptivePlant | SteppedPlant:
        if not self._adaptive:
            return SteppedPlant(physics, self._stepping)
        equations = EQUATIONS[self._machine.file.equations or ""]
        return AdaptivePlant(physics, equations(physics.model))

    def _stepped(self, physics: Physics) -> SteppedPlant:
        return SteppedPlant(physics, self._fine())

    def _fine(self) -> Stepping:
        """Return how a stand-in for the plant is stepped, the plant without the effect as well."""
        if not self._adaptive:
            return self._stepping
        return _FINE_SERVO if self._servo else _FINE

    def _reference(self) -> Reference:
        contact, fine = self._machine.file.contact, self._fine()
        plain = SteppedPlant(Draft.begin(self._machine, self._true).finished(), fine)
        horizon = CONTACT_HORIZON if contact else HORIZON
        return Reference(plain.model, fine.divide, horizon, contact)

    def _roll(self, plant: AdaptivePlant | SteppedPlant, part: str, seconds: float) -> Rolled:
        """Roll a plant out for the first `seconds` of a part's motion."""
        whole = round(getattr(self._suite.seconds, part) / self._dt)
        rng = np.random.default_rng(self._seeds[part])
        motion = MotionCommand(
            self._machine, whole * self._dt, rng, self._noise(part), self._quantum, self._amplitude
        )
        return plant.roll(motion, min(round(seconds / self._dt), whole), self._dt)

    def _noise(self, part: str) -> Float[np.ndarray, "T n"]:
        rows = round(getattr(self._suite.seconds, part) / self._dt)
        rng = np.random.default_rng((self._seeds[part], 1))
        return np.asarray(rng.normal(0.0, self._sigma, (rows, self._machine.compiled.nv)))

    def _noise_vector(self) -> Float[np.ndarray, " n"]:
        return np.full(self._machine.compiled.nv, self._sigma)

    def _within(self, rolled: Rolled) -> bool:
        """Whether a motion keeps the limits of the machine."""
        for joint, limit in self._machine.file.limits.items():
            dof = self._machine.dof(joint)
            q, v = rolled.qpos[:, dof], rolled.qvel[:, dof]
            if limit.position and not limit.position[0] <= q.min() <= q.max() <= limit.position[1]:
                return False
            if limit.velocity and np.abs(v).max() > limit.velocity:
                return False
        return True

    def _ended(self, c: Concealed, physics: Physics, train: Rolled) -> Concealed:
        """Return an effect as the catalogue measures it on the recording that was made."""
        if c.effect != "actuator_saturation":
            return c
        a = int(self._machine.compiled.actuator(c.site).id)
        limit = c.details["of"] - c.value
        drive = replace(physics.drives[a], limit=float("inf"))
        lost = float(np.abs(drive_force(drive, train, a)).max()) - limit
        if lost <= 0:
            raise _Unreachable("the limit was never reached")
        return replace(c, value=limit, details={"torque lost": lost})

    def _recording(self, part: str, rolled: Rolled) -> Recording:
        """Return what the machine's log holds: rounded noisy positions and commands."""
        m = self._machine.compiled
        readings = rounded(rolled.read + self._noise(part)[: len(rolled.time)], self._quantum)
        joints = [self._machine.joint(dof) for dof in range(m.nv)]
        units = {f"qpos.{j}": "m" if int(m.joint(j).type[0]) == SLIDE else "rad" for j in joints}
        return Recording.from_arrays(
            rolled.time,
            name=part,
            units=units,
            qpos={j: readings[:, k] for k, j in enumerate(joints)},
            ctrl={m.actuator(a).name: rolled.ctrl[:, a] for a in range(m.nu)},
        )

    def _truth(self, found: Sequence[tuple[Concealed, float]], total: float) -> dict[str, Any]:
        effects = [
            c.plain() | {"size": size, "known": REALISED[c.effect].known} for c, size in found
        ]
        plant: dict[str, Any] = {
            "sigma": self._sigma,
            "quantum": self._quantum,
            "amplitude": self._amplitude,
        }
        if not self._adaptive:
            plant |= asdict(self._stepping)
        return {
            **self._draw.plain(),
            "effects": effects,
            "size": total,
            "plant": plant,
            "parameters": {p.name: v for p, v in zip(self._parameters, self._values, strict=True)},
        }


def _slope(last: tuple[float, float], now: tuple[float, float]) -> float:
    """Return d log size / d log value between two magnitudes, within reason."""
    if not last[0] or last[0] == now[0] or last[1] == now[1]:
        return 1.0
    slope = np.log(now[1] / last[1]) / np.log(now[0] / last[0])
    return float(np.clip(slope, 0.3, 4.0))
