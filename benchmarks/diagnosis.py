"""How often the diagnosis is right, and how well its repaired models forecast.

Cases are drawn with fixed seeds (`diagnosis_cases.py`): the nominal model with effects in it,
stepped eight times finer, seen through noisy joint positions. Each figure is a share and the
number of its cases; "singles" and "pairs" count sizes from 2 sigma up.
"""

import time
from collections.abc import Iterator

import numpy as np
from common import Cases, benchmark
from diagnosis_cases import RIGS, STRANGE, Case, Planted, draw, draw_group, draw_strange, load

from bo_sysid.diagnosis.diagnose import make_evidence
from bo_sysid.diagnosis.explain import Outcome, explain
from bo_sysid.diagnosis.forecast import AHEAD, LONGER, PAST, forecast, forecast_problem
from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.locate import Evidence, Located, locate
from bo_sysid.effects import CATALOGUE

SMALL = ("two_link_arm", "cart_pole", "rotary_pendulum")
LARGE = ("six_motors", "six_servos")
# what a discrete wiring fault, a new state or a recorded voltage needs has tests of its own
SKIPPED = ("channel_swap", "sensor_sign", "timestep", "voltage_sag", "contact_friction",
           "contact_softness", "backlash", "joint_compliance")  # fmt: skip


def plan(quick: bool) -> Iterator[tuple[str, str, int, str]]:
    """Yield suite, machine, seed and detail of every case."""
    ids = [i for i, e in CATALOGUE.items() if e.family != "learned" and i not in SKIPPED]
    repeats = 1 if quick else 10
    for seed in range(repeats):
        for rig in SMALL if quick else (*SMALL, *LARGE):
            for id in ids[:: 6 if quick else 1]:
                yield "single", rig, seed, id
            yield "pair", rig, seed, ""
            yield "lugre", rig, seed, "dry_friction"
        for rig in SMALL:
            for kind in STRANGE[:: 2 if quick else 1]:
                yield "unknown", rig, seed, kind
    for seed in range(3 if quick else 50):
        for rig in SMALL:
            yield "nothing", rig, seed, ""
    if not quick:
        for rig in LARGE:
            for id in ("dry_friction", "armature"):
                yield "group", rig, 0, id


def make(suite: str, rig: str, seed: int, detail: str) -> Case | None:
    """Draw a case; None where the effect does not apply to the machine or cannot be sized."""
    key = [seed, sorted(RIGS).index(rig), *detail.encode()]
    rng = np.random.default_rng(key)
    ids = [i for i, e in CATALOGUE.items() if e.family != "learned" and i not in SKIPPED]
    if suite == "single":
        case = draw(rng, rig, [detail], 1)
    elif suite == "lugre":
        case = draw(rng, rig, [detail], 1, lugre=True)
    elif suite == "pair":
        case = draw(rng, rig, ids, 2)
    elif suite == "unknown":
        case = draw_strange(rng, rig, detail)
    elif suite == "group":
        case = draw_group(rng, rig, detail)
    else:
        case = draw(rng, rig, ids, 0)
    wanted = {"single": 1, "lugre": 1, "pair": 2}.get(suite, 0)
    return case if len(case.truth) >= wanted else None


def judged(case: Case) -> dict[str, object]:
    """Diagnose a case and compare with what was planted."""
    model, began, cpu = load(case.rig), time.perf_counter(), time.process_time()
    evidence = make_evidence(model, case.train)
    located = locate(evidence)
    outcome = explain(located)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    found = outcome.fit
    truth = {(p.effect, p.site) for p in case.truth}
    got = {c.key for c in found.members}
    alike = [{c.key for c in f.members} for f in located.decision.equivalents[:2]]
    return {
        "truth": [[p.effect, p.site, list(p.x), p.size] for p in case.truth],
        "found": [[*c.key, x.tolist()] for c, x in zip(found.members, found.x, strict=True)],
        "right": got == truth,
        "class": got == truth or truth in alike,
        "flagged": outcome.unexplained.flagged,
        "site": outcome.unexplained.site,
        "depends_on": list(outcome.unexplained.depends_on),
        "planted": case.notes,
        "probability": float(located.decision.probability[0]),
        "inside": _inside(case.truth, found),
        "rms": found.rms,
        "forecasts": _forecasts(evidence, located, outcome, case),
        "seconds": seconds,
        "cpu": cpu,
        "smallest": min((p.size for p in case.truth), default=0.0),
    }


def _inside(truth: tuple[Planted, ...], fit) -> list[bool]:
    """Return for each planted effect that was found whether the 95 % interval holds it."""
    out, first = [], 0
    for c, x in zip(fit.members, fit.x, strict=True):
        variance = fit.covariance[first, first]
        first += c.size
        half = 1.96 * np.sqrt(variance + (0.005 * x[0]) ** 2 + (c.effect.unit == "s") * 9e-8)
        out += [
            bool(abs(x[0] - p.x[0]) <= half)
            for p in truth
            if (p.effect, p.site) == c.key and c.effect.vector == 1
        ]
    return out


def _forecasts(
    evidence: Evidence, located: Located, outcome: Outcome, case: Case
) -> dict[str, list[float]]:
    out = {}
    for ahead in (AHEAD, LONGER):
        problem, past = forecast_problem(
            evidence.model, evidence.machine, case.holdout, evidence.sigma, past=PAST, ahead=ahead,
            timestep=outcome.timestep, engine=evidence.engine,
        )  # fmt: skip
        errors = [forecast(problem, past, h) for h in (Hypothesis(), outcome.repaired)]
        out[f"{ahead:g}"] = [errors[0].ahead, errors[1].ahead, errors[1].floor]
    return out


def summary(rows: list[dict]) -> dict[str, object]:
    """Return the figures of the acceptance, with their numbers of cases."""

    def share(chosen: list[dict], value) -> list[float]:
        return [
            round(float(np.mean([value(r) for r in chosen])), 4) if chosen else None,
            len(chosen),
        ]

    of = lambda *suites: [r for r in rows if r["suite"] in suites]  # noqa: E731
    seen = lambda rs: [r for r in rs if r["smallest"] >= 2]  # noqa: E731
    good = lambda r: r["forecasts"]["0.08"][1] <= 1.15 * r["forecasts"]["0.08"][2]  # noqa: E731
    longer = lambda r: r["forecasts"]["0.3"][1] <= 1.15 * r["forecasts"]["0.3"][2]  # noqa: E731
    right = lambda r: r["class"] and not r["flagged"]  # noqa: E731
    inside = [i for r in of("single", "pair") for i in r["inside"]]
    closed = lambda r: _closed(r["forecasts"]["0.08"]) >= 0.8  # noqa: E731
    return {
        "singles": share(seen(of("single")), right),
        "pairs": share(seen(of("pair")), right),
        "nothing": share(of("nothing"), lambda r: not r["found"] and not r["flagged"]),
        "unknown_flagged": share(of("unknown"), lambda r: r["flagged"]),
        "unknown_located": share(of("unknown"), lambda r: r["site"] == r["planted"].get("site")),
        "unknown_closed": share(of("unknown"), closed),
        "unknown_named": share(of("unknown"), lambda r: bool(r["found"]) and not r["flagged"]),
        "groups": share(of("group"), lambda r: r["right"]),
        "inside_95": [round(float(np.mean(inside)), 4) if inside else None, len(inside)],
        "forecast_80ms": share(of("single", "pair"), good),
        "forecast_300ms": share(of("single", "pair"), longer),
        "forecast_lugre_80ms": share(of("lugre"), good),
        "lugre_right": share(of("lugre"), right),
        "cpu_median_s": round(float(np.median([r["cpu"] for r in rows])), 1) if rows else None,
    }


def _closed(errors: list[float]) -> float:
    nominal, repaired, floor = errors
    return (nominal - repaired) / max(nominal - floor, 1e-9)


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Diagnose every case that is not there yet; return the figures."""
    rows = []
    for suite, rig, seed, detail in plan(quick):

        def compute(s=suite, r=rig, n=seed, d=detail) -> dict[str, object] | None:
            case = make(s, r, n, d)
            return None if case is None else {"suite": s, "rig": r, **judged(case)}

        row = cases.get(f"{suite} {rig} {seed} {detail}".strip(), compute)
        if row is not None:
            rows.append(row)
            if not row["class"]:
                print(f"    planted {row['truth'] or row['planted']}, found {row['found']}")
    return summary(rows)


if __name__ == "__main__":
    benchmark("diagnosis", run)
