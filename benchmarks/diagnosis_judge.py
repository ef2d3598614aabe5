"""Which cases the benchmark of the diagnosis has, and how an answer is judged."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from diagnosis_cases import Case, draw, draw_geared, draw_group, draw_strange, measured
from diagnosis_plant import Planted
from diagnosis_rigs import CONTACT, LOGS, RIGS, load
from diagnosis_strange import STRANGE

from bo_sysid.diagnosis.answer.answer import make_answer
from bo_sysid.diagnosis.answer.explain import Outcome, explain
from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.trifle import with_trifle
from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.forecast import (
    AHEAD,
    LONGER,
    PAST,
    forecast,
    forecast_problem,
    noise_floor,
)
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE
from bo_sysid.execution import threads
from bo_sysid.mjcf import Address, Model
from bo_sysid.parameters import Parameter
from bo_sysid.proof.marks import MOST_IN_CLASS, class_size, named, offers

SMALL = ("two_link_arm", "cart_pole", "rotary_pendulum")
LARGE, BARE = ("six_motors", "six_servos"), "six_bare"
ROUNDS, PAIR_ROUNDS, CONTACT_ROUNDS = 16, 37, 2
_GEARED_ROUNDS, _MASSES_ROUNDS, _LOAD_ROUNDS, _NOISY_ROUNDS = 10, 4, 6, 3
_THROUGH_NOISE = ("dry_friction", "viscous_damping", "actuator_gain", "payload", "armature")
TOUCHING = ("dry_friction", "payload", "gravity_tilt", "actuator_gain", "contact_friction")
# what a discrete wiring fault, a new state or a recorded voltage needs has tests of its own
SKIPPED = (
    "channel_swap",
    "sensor_sign",
    "timestep",
    "voltage_sag",
    "contact_friction",
    "contact_softness",
)


def plan(quick: bool) -> Iterator[tuple[str, tuple[str, ...], int, str]]:
    """Yield suite, machines in the order of preference, seed and detail of every case.

    Round by round, each with every id once, so that what is finished is fair to all at any time.
    """
    ids = [i for i, e in CATALOGUE.items() if e.family != "learned" and i not in SKIPPED]
    rigs = SMALL if quick else (*SMALL, *LARGE)
    for seed in range(1 if quick else ROUNDS):
        for k, id in enumerate(ids[:: 3 if quick else 1]):
            yield "single", _turned(rigs, seed + k), seed, id
        for rig in rigs:
            yield "pair", (rig,), seed, ""
            yield "nothing", (rig,), 3 * seed, ""
        for rig in SMALL:
            yield "nothing", (rig,), 3 * seed + 1, ""
            yield "nothing", (rig,), 3 * seed + 2, ""
        for k, kind in enumerate(STRANGE):
            yield "unknown", _turned(SMALL, seed + k), seed, kind
        for rig in rigs:  # a parameter of the study is off, and nothing is missing
            yield "off", (rig,), seed, "viscous_damping"
        for k, log in enumerate(LOGS):
            for j, rig in enumerate(SMALL):
                chosen = ids[(len(SMALL) * (len(LOGS) * seed + k) + j) % len(ids)]
                yield "log", (rig, *_turned(SMALL, j + 1)[:2]), seed, f"{chosen} at {log}"
        yield "lugre", _turned(rigs, seed), seed, "dry_friction"
        if not quick and seed < _GEARED_ROUNDS:
            yield "geared", (BARE,), seed, ""
        if not quick and seed < _MASSES_ROUNDS:
            yield "masses", (BARE,), seed, ""
        if not quick and seed < 2:
            for rig in LARGE:
                for id in ("dry_friction", "armature"):
                    yield "group", (rig,), seed, id
    for seed in range(ROUNDS, ROUNDS if quick else PAIR_ROUNDS):  # few of a round reach 2 sigma
        for rig in rigs:
            yield "pair", (rig,), seed, ""
    for seed in range(0 if quick else _LOAD_ROUNDS):
        for rig in rigs:
            yield "load", (rig,), seed, ""
    for seed in range(0 if quick else _NOISY_ROUNDS):
        for k, id in enumerate((*_THROUGH_NOISE, "")):
            yield "noisy", _turned(SMALL, seed + k), seed, id
    for seed in range(0 if quick else CONTACT_ROUNDS):  # minutes each
        for rig in CONTACT:
            for id in TOUCHING:
                yield "contact", (rig,), seed, id
            yield "contact_nothing", (rig,), seed, ""


def _turned(rigs: tuple[str, ...], by: int) -> tuple[str, ...]:
    return rigs[by % len(rigs) :] + rigs[: by % len(rigs)]


def make(suite: str, rig: str, seed: int, detail: str) -> Case | None:
    """Draw a case; None where the effect does not apply to the machine or cannot be sized."""
    order = [*sorted(set(RIGS) - {*CONTACT, BARE}), *CONTACT, BARE]  # later rigs last: seeds stay
    key = [seed, order.index(rig), *detail.encode()]
    rng = np.random.default_rng(key)
    ids = [i for i, e in CATALOGUE.items() if e.family != "learned" and i not in SKIPPED]
    if suite in ("single", "off"):
        case = draw(rng, rig, [detail], 1)
    elif suite == "load":
        case = draw(rng, rig, ["payload"], 1, low=2.0, elsewhere=True)
    elif suite == "noisy":
        count = int(bool(detail))
        case = draw(rng, rig, [detail] if detail else ids, count, low=30.0, high=300.0)
        case = measured(rng, case)
    elif suite == "contact":
        case = draw(rng, rig, [detail], 1, low=3.0)
    elif suite == "lugre":
        case = draw(rng, rig, [detail], 1, lugre=True)
    elif suite == "log":
        id, log = detail.split(" at ")
        case = draw(rng, rig, [id], 1, log=LOGS[log])
    elif suite == "pair":
        case = draw(rng, rig, ids, 2)
    elif suite == "unknown":
        case = draw_strange(rng, rig, detail)
    elif suite in ("geared", "masses"):
        case = draw_geared(rng, rig, masses=suite == "masses")
    elif suite == "group":
        case = draw_group(rng, rig, detail)
    else:
        case = draw(rng, rig, ids, 0)
    alone = ("single", "off", "log", "lugre", "contact", "load")
    wanted = 2 if suite == "pair" else int(suite in alone or (suite == "noisy" and bool(detail)))
    if not case.train or len(case.truth) < wanted:
        return None
    if suite == "off":  # what was planted is a parameter of the study
        (planted,) = case.truth
        case = replace(case, truth=(), notes={"damping": planted.site, "off by": planted.value})
    return case


def judged(case: Case) -> dict[str, object]:
    """Diagnose a case and compare with what was planted."""
    model, began, cpu = _given(case), time.perf_counter(), time.process_time()
    evidence = make_evidence(model, case.train, parameters=_parameters(case), threads=threads())
    located = with_trifle(locate(evidence))
    outcome = explain(located)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    found = outcome.fit
    said = make_answer(located.decision, outcome, evidence.machine).findings
    told = [f.as_json() for f in said]
    truth = frozenset((p.effect, p.kind, p.site) for p in case.truth)
    got = named(told)
    alone = len(got) == len(told)  # no time step is named beside them
    few = alone and class_size(told) <= MOST_IN_CLASS
    return {
        "truth": [[p.effect, p.site, p.value, p.size] for p in case.truth],
        "found": [[f.effect, f.site, f.quantity.value] for f in said],
        "right": alone and got == truth,
        "class": (alone and got == truth) or (few and offers(told, truth)),
        "flagged": outcome.unexplained.flagged,
        "site": outcome.unexplained.site,
        "depends_on": list(outcome.unexplained.depends_on),
        "planted": case.notes,
        "probability": float(located.decision.probability[0]),
        "inside": _inside(case.truth, said),
        "place_inside": _place_inside(case.truth, said),
        "rms": found.rms,
        "nominal_rms": located.decision.nominal.rms,
        "forecasts": _forecasts(evidence, located, outcome, case),
        "seconds": seconds,
        "cpu": cpu,
        "smallest": min((p.size for p in case.truth), default=0.0),
    }


def _given(case: Case) -> Model:
    """Return the model of the machine that is diagnosed, with the masses that are off."""
    model, masses = load(case.rig), case.notes.get("masses")
    if not isinstance(masses, dict):
        return model
    spec = model.spec()
    for name, mass in masses.items():
        spec.geom(name).mass = mass
    return Model.from_xml(spec.to_xml())


def _parameters(case: Case) -> list[Parameter]:
    """Return the study's parameters: the damping that is off, or the masses, where they are."""
    if isinstance(masses := case.notes.get("masses"), dict):
        addresses = {name: f"geom[{name}].mass" for name in masses}
        return [Parameter(n, (a,), 0.5 * masses[n], 2 * masses[n]) for n, a in addresses.items()]
    if "damping" not in case.notes:
        return []
    address = f"joint[{case.notes['damping']}].damping"
    own = Address.parse(address).read(load(case.rig))
    high = own + 5 * float(str(case.notes["off by"]))
    return [Parameter("damping", (address,), 0.0, high, 11)]


def _inside(truth: tuple[Planted, ...], said: Sequence[Finding]) -> list[bool]:
    """Return for each planted effect that was found whether the 95 % interval holds its value."""
    intervals = {(f.effect, f.site): f.quantity.interval for f in said}
    known = [p for p in truth if (p.effect, p.site) in intervals]
    held = ((p.value, intervals[p.effect, p.site]) for p in known)
    return [low <= value <= high for value, (low, high) in held]


def _place_inside(truth: tuple[Planted, ...], said: Sequence[Finding]) -> list[bool]:
    """Return for each coordinate that is said of a load whether its interval holds the truth."""
    loads = {p.site: p.x[1:] for p in truth if p.effect == "payload"}
    told = [f for f in said if f.effect == "payload" and f.site in loads and f.details]
    return [
        f.details[axis].interval[0] <= place <= f.details[axis].interval[1]
        for f in told
        for axis, place in zip("xyz", loads[f.site], strict=True)
    ]


def _forecasts(
    evidence: Evidence, located: Located, outcome: Outcome, case: Case
) -> dict[str, list[float]]:
    out = {}
    for ahead in (AHEAD, LONGER):
        problem, past = forecast_problem(
            evidence.model, evidence.machine, case.holdout, evidence.sigma, past=PAST, ahead=ahead,
            timestep=outcome.timestep, engine=evidence.engine,
            input_noise=located.evidence.input_noise,
        )  # fmt: skip
        nominal, repaired = (forecast(problem, past, h) for h in (Hypothesis(), outcome.repaired))
        floor = noise_floor(problem, past, outcome.repaired, repaired)
        out[f"{ahead:g}"] = [nominal.ahead, repaired.ahead, floor]
    return out


def computed(job: tuple[str, tuple[str, ...], int, str]) -> dict[str, object] | None:
    """Return the judged case of the first machine that a case can be drawn on, None without one."""
    suite, machines, seed, detail = job
    for rig in machines:
        case = make(suite, rig, seed, detail)
        if case is not None:
            return {"suite": suite, "rig": rig, **judged(case)}
    return None
