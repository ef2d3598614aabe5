"""What a diagnosis is made from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bo_sysid.diagnosis.windows.candidate import Candidate, candidates, parameter_candidates
from bo_sysid.diagnosis.windows.channel_noise import channel_noise, timing_note
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.diagnosis.windows.law_controls import driven
from bo_sysid.diagnosis.windows.recorded_contact import shows_impacts, without_unused_contact
from bo_sysid.effects import CATALOGUE, Effect, Filter, Machine, survey
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.address import resolve
from bo_sysid.mjcf.values import compiled_value
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import instants_each
from bo_sysid.simulation import Controller, Engine, ForceLaw

CONTACT_WINDOW = 0.1
"""Length in [s] of a window where contact decides."""

_WINDOW = 0.3  # [s]
_WHOLE = 1e-9  # instants, by which what is a whole number of them may be off
_STILL = 1.5  # [sigma] of an encoder, below which a joint's positions vary by noise alone


@dataclass(frozen=True)
class Evidence:
    """What a diagnosis is made from.

    Attributes:
        model: the nominal model, without contact where the recordings show none.
        given: the same as it was given.
        machine: the scales of its sites.
        recordings: the training recordings.
        sigma: noise of each observed channel.
        nuisances: the study's parameters.
        candidates: what may be missing.
        most: most effects at once.
        window: length of a window in [s].
        engine: simulates.
        laws: controllers and force laws that belong to the nominal model.
        kept: long fits of a diagnosis that was killed.
        skipped_start: time in [s] after a log's first command in which nothing is compared.
        input_noise: σ of what recorded controls show and the machine did not get, by actuator.
        too_short: names of recordings that are left out, since they hold no window.
        lead: time in [s] from where windows begin until what is compared there.
        simulated: whether the recordings show the model's own time step, as those of a simulation.
    """

    model: Model
    given: Model
    machine: Machine
    recordings: tuple[Recording, ...]
    sigma: dict[str, float]
    nuisances: tuple[Candidate, ...]
    candidates: tuple[Candidate, ...]
    most: int
    window: float
    engine: Engine
    laws: tuple[Controller | ForceLaw, ...]
    kept: FitCache
    skipped_start: float = 0.0
    input_noise: Mapping[str, float] = field(default_factory=dict)
    too_short: tuple[str, ...] = ()
    lead: float = 0.0
    simulated: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What was done to the model, in words."""
        yielding = self.model.loops.yielding
        notes = [
            f"{joint} is tied to {other}: what acts on one acts on the other, and "
            + (
                "only how that tie gives way tells where."
                if joint in yielding
                else "is named there."
            )
            for joint, other in self.model.loops.mirrored.items()
            if joint in self.machine.joints
        ]
        following = [j for j in self.model.loops.joints if j not in self.machine.joints]
        if following:
            notes.append(f"{', '.join(following)}: not recorded, as the model's equalities say.")
        if self.model is not self.given:
            notes.append("Nothing touches in the training recordings: contact is left out there.")
        if self.too_short:
            notes.append(
                f"{', '.join(self.too_short)}: left out, with fewer samples than a window has."
            )
        if self.skipped_start:
            whole = ", ".join(r.name for r in self.recordings if not self._begins_late(r))
            notes.append(
                f"Positions in the first {self.skipped_start:.2g} s after a log's first command "
                f"are not compared{f', but in {whole}, of which half would go' if whole else ''}: "
                "a late drive acts there on what was sent before, if anything was."
            )
        return (*notes, *timing_note(self.recordings, self.sigma))

    def horizons(self, instants: int, least: int) -> list[int]:
        """Return the instants of each recording in windows that last as long as so many usually do.

        Recordings of another rate have more or fewer, `least` at least.
        """
        compared = {*self.model.qpos_channels, *self.sigma}
        each = instants_each(instants, self.machine.sampling, self.recordings, compared)
        return [h if h == instants else max(h, least) for h in each]

    def leads(self, horizon: int) -> list[int]:
        """Return the instants of each recording from where a window begins until it is compared.

        None in one that is too short for two such windows.

        Args:
            horizon: instants that are compared in a window of a recording of the usual rate.
        """
        lead = int(np.ceil(self.lead / self.machine.sampling - _WHOLE))
        each = self.horizons(lead, 1) if lead else [0] * len(self.recordings)
        whole = (lead + horizon) * self.machine.sampling
        return [
            n if r.duration > 2 * whole else 0 for n, r in zip(each, self.recordings, strict=True)
        ]

    def with_contact_of(self, recordings: Sequence[Recording]) -> "Evidence":
        """Return the same with the contact and the impacts of others, where it has none so far."""
        touched = without_unused_contact(self.given, recordings) is self.given
        if self.model is not self.given and not touched:
            return self
        impacts = self.machine.impacts or shows_impacts(self.given, recordings, self.sigma)
        if self.model is self.given and impacts == self.machine.impacts:
            return self
        whole = replace(self.machine, model=self.given.compile(), impacts=impacts)
        return replace(self, model=self.given, machine=whole)

    def with_impacts(self) -> "Evidence":
        """Return the same in short windows, where a contact decides as impacts do."""
        machine = replace(self.machine, impacts=True)
        return replace(self, machine=machine, window=CONTACT_WINDOW)

    def skipping_start(self, seconds: float) -> "Evidence":
        """Return the same, compared from some time in [s] after the logs' first commands on."""
        made = replace(self, skipped_start=seconds)
        return replace(made, recordings=made.without_skipped_start(self.recordings))

    def without_skipped_start(self, recordings: Sequence[Recording]) -> tuple[Recording, ...]:
        """Return recordings without the positions that are not compared, all commands in them.

        One of which half would go stays whole.
        """
        return tuple(
            r.between(first_command(r) + self.skipped_start, np.inf) if self._begins_late(r) else r
            for r in recordings
        )

    def _begins_late(self, recording: Recording) -> bool:
        """Whether positions of a recording are compared from later on, and most of them are.

        That is judged by what follows its first command, also where some of it has gone already.
        """
        first = first_command(recording)
        half = 0.5 * (recording.span[1] - first)
        return 0.0 < self.skipped_start < half

    @property
    def still(self) -> tuple[str, ...]:
        """The recorded joints that move no more than the noise of their encoders, or not at all."""
        recorded = set().union(*(r.channels for r in self.recordings))
        noise = {j: self.sigma.get(f"qpos.{j}", np.inf) for j in self.machine.joints}
        return tuple(
            name
            for name, joint in self.machine.joints.items()
            if f"qpos.{name}" in recorded and joint.spread < _STILL * noise[name]
        )

    @property
    def rigid(self) -> "Evidence":
        """The same without candidates that add a joint."""
        held = tuple(c for c in self.candidates if not c.effect.hidden)
        return replace(self, candidates=held)


def first_command(recording: Recording) -> float:
    """Return the time in [s] of the first command of a log, of the log itself where it has none."""
    sent = [float(c.time[0]) for c in recording.of_kind("ctrl").values()]
    return min(sent, default=recording.origin)


def _window(machine: Machine) -> float:
    """Return the length of a window: short where impacts soon decide, else long."""
    return CONTACT_WINDOW if machine.impacts else _WINDOW


def make_evidence(
    model: Model,
    recordings: Sequence[Recording],
    *,
    effects: Sequence[Effect] | None = None,
    parameters: Sequence[Parameter] = (),
    noise: Mapping[str, float] | None = None,
    most: int = 3,
    threads: int = 0,
    laws: Sequence[Controller | ForceLaw] = (),
    known: Sequence[str] = (),
    kept: FitCache = NO_CACHE,
) -> Evidence:
    """Measure scales and noise, and list what may be missing.

    Args:
        model: the nominal model.
        recordings: the training recordings.
        effects: what to look for; by default the whole catalogue.
        parameters: of the study, fitted beside everything.
        noise: σ by channel or by kind of channel, where known.
        most: most effects at once.
        threads: of the simulation, 0 for all cores.
        laws: controllers and force laws that belong to the nominal model.
        known: addresses whose values are certain: what would change one is not looked for.
        kept: long fits of a diagnosis that was killed.

    Raises:
        RecordingError: no joint's position was recorded, or none moves.
        ModelError: an address of `known` matches nothing.
    """
    given, model = model, without_unused_contact(model, recordings)
    compiled = model.compile()
    machine = survey(compiled, driven(compiled, recordings, laws))
    wanted = tuple(CATALOGUE.values()) if effects is None else effects
    wanted = [e for e in wanted if e.family != "numerics"]  # fits take the step along as it is
    sigma = channel_noise(recordings, machine, noise or {})
    machine = replace(machine, impacts=shows_impacts(model, recordings, sigma))
    window = _window(machine)
    lasting = _lasting(recordings, round(window / machine.sampling), machine.sampling)
    offered = _observed(_once(model, candidates(wanted, machine)), machine, sigma)
    return Evidence(
        model,
        given,
        machine,
        lasting,
        sigma,
        parameter_candidates(model, parameters),
        _possible(model, machine, _felt(model, machine, offered, laws), known),
        most,
        window,
        Engine(threads),
        tuple(laws),
        kept,
        too_short=tuple(sorted({r.name for r in recordings} - {r.name for r in lasting})),
    )


def _lasting(
    recordings: Sequence[Recording], instants: int, interval: float
) -> tuple[Recording, ...]:
    """Return the recordings that are longer than so many instants; all if none is.

    Args:
        recordings: of which some may be short.
        instants: at the usual interval.
        interval: that usual one in [s].
    """
    lasting = []
    for recording in recordings:
        positions = {n: c for n, c in recording.channels.items() if n.startswith("qpos.")}
        longest = max((len(c.time) for c in positions.values()), default=0)
        if longest > instants_each(instants, interval, [recording], positions)[0]:
            lasting.append(recording)
    return tuple(lasting or recordings)


def _once(model: Model, all_of: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates without the physics of joints that follow in proportion to another.

    It does what the same does at the other joint, unless the tie gives way by what encoders show.
    """
    mirrored = model.loops.mirrored.keys() - model.loops.yielding
    return tuple(
        c for c in all_of
        if not (c.effect.family == "physics" and c.site.kind == "joint")
        or c.site.name not in mirrored
    )  # fmt: skip


def _observed(
    all_of: Sequence[Candidate], machine: Machine, sigma: Mapping[str, float]
) -> tuple[Candidate, ...]:
    """Return the candidates without channels that are not compared, or swapped with such a one."""

    def compared(c: Candidate) -> bool:
        swapped = c.effect.id == "channel_swap"
        other = machine.channels[round(float(c.shapes[0]))] if swapped else c.site.name
        return c.site.kind != "channel" or {c.site.name, other} <= sigma.keys()

    return tuple(filter(compared, all_of))


def _felt(
    model: Model,
    machine: Machine,
    all_of: Sequence[Candidate],
    laws: Sequence[Controller | ForceLaw],
) -> tuple[Candidate, ...]:
    """Return the candidates without those that change a control which a law of the study makes."""
    made = {w.actuator for w in laws if isinstance(w, Controller)}
    if not made:
        return tuple(all_of)

    def changes(c: Candidate) -> bool:
        edits, parts = edits_and_parts(Hypothesis((c,), (c.point[: c.size],)), machine)
        spec = model.spec()
        for edit in edits:
            edit(spec)
        return any(isinstance(p, Filter) and p.actuator in made for p in parts)

    return tuple(c for c in all_of if not changes(c))


def _possible(
    model: Model, machine: Machine, all_of: Sequence[Candidate], known: Sequence[str]
) -> tuple[Candidate, ...]:
    """Return the candidates that leave every known number of the model as it is."""
    targets = [t for address in known for t in resolve(model, address)]
    if not targets:
        return tuple(all_of)
    nominal = [compiled_value(machine.model, t) for t in targets]
    kept = []
    for c in all_of:
        hypothesis = Hypothesis((c,), (c.point[: c.size],))
        edited = model.compile(edits_and_parts(hypothesis, machine)[0])
        if [compiled_value(edited, t) for t in targets] == nominal:
            kept.append(c)
    return tuple(kept)
