"""Head to head on concealed development cases: this diagnosis, mujoco.sysid, and PySINDy.

All see one and the same recording of a machine that lacks up to two kinds of physics, or none, and
are judged by the forecast error on the hold-out: 80 ms from the past alone, in sensor sigma.
mujoco.sysid is given the nominal structure, and once more the right structure with sensible starts
and its own delays (peer_sysid.py); smoothing + inverse dynamics + PySINDy finds terms by itself
(peer_sindy.py), with its settings tuned on cases of the development suite that are not counted. A
peer's model is judged at the nominal time step and at a quarter of it, and the better one counts.
Needs `pip install 'bo-sysid[peers]'`.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import peer_sindy
import peer_sysid
from common import Cases, benchmark

from bo_sysid.diagnosis import diagnose
from bo_sysid.diagnosis.gather import gather
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import AHEAD, PAST, forecast, forecast_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.proof.develop import develop
from bo_sysid.proof.marks import mark, named
from bo_sysid.proof.oracle import true_hypothesis
from bo_sysid.proof.statistics import clopper_pearson
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_holdout, load_train

SUITE = Path(__file__).parents[1] / "studies" / "concealed" / "development.yaml"
FOLDER = Path(__file__).parents[1] / "runs" / "peers-cases"
TUNED_ON, COUNTED = range(4), range(4, 24)  # cases of the suite
CHANGES = {"seconds": {"train": 15.0, "holdout": 6.0}}
PEERS = ("sysid_nominal", "sysid_right", "sindy")


def judged(evidence: Evidence, study: Study, hypothesis: Hypothesis, finer: bool) -> float:
    """Return the forecast error of a hypothesis on the hold-out in sensor sigma.

    Args:
        evidence: of the case.
        study: of the case.
        hypothesis: that is judged.
        finer: also judge it at a quarter of the time step; the better one counts.
    """
    problem, past = forecast_problem(
        evidence.model, evidence.machine, load_holdout(study), evidence.sigma, past=PAST,
        ahead=AHEAD, timestep=float(evidence.machine.model.opt.timestep), engine=evidence.engine,
    )  # fmt: skip
    plain = Hypothesis(
        hypothesis.members, hypothesis.x, hypothesis.nuisances, hypothesis.nuisance_x
    )
    fine = Hypothesis(plain.members, plain.x, plain.nuisances, plain.nuisance_x, numerics=1.0)
    errors = [forecast(problem, past, h).ahead for h in ((plain, fine) if finer else (plain,))]
    return float(min(errors))


def answered_by_peers(
    study: Study, truth: Mapping[str, Any], settings: peer_sindy.Settings
) -> dict[str, Any]:
    """Answer one case with the peers; also say what it conceals and what the truth is worth."""
    evidence = gather(study, load_train(study))
    right = true_hypothesis(study, evidence, truth)
    out: dict[str, Any] = {
        "machine": truth["machine"],
        "tier": truth["tier"],
        "concealed": [f"{e['effect']} at {e['site']}" for e in truth["effects"]],
        "size": min((float(e["size"]) for e in truth["effects"]), default=0.0),
        "nominal": {"error": judged(evidence, study, Hypothesis(), finer=True)},
        "sysid_nominal": _guarded(partial(_sysid, evidence, study, (), nominal=True)),
        "sindy": _guarded(partial(_sindy, evidence, study, truth, settings)),
    }
    if right is None:
        return {**out, "sysid_right": {"skipped": "the catalogue does not have it"}}
    out["oracle"] = {"error": judged(evidence, study, right, finer=True)}
    if not peer_sysid.expressible(right, evidence):
        return {**out, "sysid_right": {"skipped": "neither MJCF nor a delay can say it"}}
    fit = partial(_sysid, evidence, study, right.members, nominal=False)
    return {**out, "sysid_right": _guarded(fit)}


def _guarded(fit: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what a method says; a method that fails has no error and is counted."""
    try:
        return fit()
    except Exception as error:
        return {"failed": f"{type(error).__name__}: {error}"[:200]}


def _ours(study: Study, truth: Mapping[str, Any]) -> dict[str, Any]:
    began = time.perf_counter()
    told = diagnose(study).as_json()
    marks = mark(truth, told)
    return {
        "error": told["holdout"]["forecast"].get("repaired"),
        "refitted": told["holdout"]["forecast"].get("refitted"),
        "floor": told["holdout"]["forecast"].get("noise_floor"),
        "seconds": time.perf_counter() - began,
        "found": marks["found"],
        "right": marks["right"],
        "warned": told["verdict"] != "nothing-missing",
        "verdict": told["verdict"],
    }


def _sysid(
    evidence: Evidence, study: Study, members: Sequence[Any], nominal: bool
) -> dict[str, Any]:
    free = peer_sysid.nominal_structure(evidence) if nominal else evidence.nuisances
    found = peer_sysid.fit(evidence, members, free, probed=True)
    return {
        "error": judged(evidence, study, found.hypothesis, finer=True),
        "seconds": found.seconds,
        "warned": bool(found.warnings),
        "warnings": list(found.warnings),
    }


def _sindy(
    evidence: Evidence, study: Study, truth: Mapping[str, Any], settings: peer_sindy.Settings
) -> dict[str, Any]:
    hypothesis, seconds = peer_sindy.fit(evidence, settings)
    found = {(c.effect.id, c.site.kind, c.site.name) for c in hypothesis.members}
    return {
        "error": judged(evidence, study, hypothesis, finer=True),
        "seconds": seconds,
        "found": ", ".join(sorted(f"{e} at {s}" for e, _, s in found)),
        "right": found == named(truth["effects"]),
        "warned": False,  # it has no way to
    }


def tune() -> dict[str, float]:
    """Return the settings of PySINDy with the least median error over the cases for tuning."""
    known = []
    for study, _ in develop(SUITE, FOLDER, cases=TUNED_ON, overrides=CHANGES):
        known.append((gather(study, load_train(study)), study))
    medians = []
    for s in peer_sindy.grid():
        errors = [judged(e, study, peer_sindy.fit(e, s)[0], finer=False) for e, study in known]
        medians.append(float(np.median(errors)))
    best = peer_sindy.grid()[int(np.argmin(medians))]
    return {"window": best.window, "threshold": best.threshold}


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the comparison; shares with their exact 95 % intervals and counts."""
    error = lambda r, who: r.get(who, {}).get("error")  # noqa: E731
    missing = [r for r in rows if r["concealed"] and error(r, "ours") is not None]
    out: dict[str, Any] = {
        "cases": len(rows),
        "with_physics_missing": len([r for r in rows if r["concealed"]]),
    }
    for who in ("sysid_nominal", "sindy"):
        both = [r for r in missing if error(r, who) is not None]
        out[f"lower_error_than_{who}"] = _share([error(r, "ours") < error(r, who) for r in both])
    both = [r for r in missing if all(error(r, w) is not None for w in ("sysid_nominal", "sindy"))]
    best = [min(error(r, "sysid_nominal"), error(r, "sindy")) for r in both]
    out["lower_error_than_both"] = _share(
        [error(r, "ours") < b for r, b in zip(both, best, strict=True)]
    )
    given = [r for r in missing if error(r, "sysid_right") is not None]
    ratios = [error(r, "ours") / error(r, "sysid_right") for r in given]
    out["within_1.1_of_sysid_right"] = _share([x <= 1.1 for x in ratios])
    out["median_ratio_to_sysid_right"] = float(np.median(ratios)) if ratios else None
    for who in ("nominal", "ours", *PEERS, "oracle"):
        told = [r[who] for r in rows if who in r and r["concealed"]]
        errors = [t["error"] for t in told if t.get("error") is not None]
        seconds = [t["seconds"] for t in told if "seconds" in t]
        out[who] = {
            "cases": len(errors),
            "failed": sum("failed" in t for t in told),
            "median_error": float(np.median(errors)) if errors else None,
            "worst_error": float(np.max(errors)) if errors else None,
            "median_seconds": float(np.median(seconds)) if seconds else None,
            "warned": _share([bool(t["warned"]) for t in told if "warned" in t]),
            "named_right": _share([bool(t["right"]) for t in told if "right" in t]),
        }
    nothing = [r for r in rows if not r["concealed"]]
    out["nothing_missing"] = {
        who: _share([bool(r[who]["warned"]) for r in nothing if "warned" in r.get(who, {})])
        for who in ("ours", "sysid_nominal")
    }
    return out


def _share(happened: Sequence[bool]) -> dict[str, Any] | None:
    if not happened:
        return None
    low, high = clopper_pearson(sum(happened), len(happened))
    return {"rate": sum(happened) / len(happened), "of": len(happened), "interval": [low, high]}


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Answer every case that is not there yet; --quick takes the first three that are counted."""
    settings = peer_sindy.Settings(**cases.get("tuning", tune))
    counted = COUNTED[:3] if quick else COUNTED
    drawn: Callable[[int], tuple[Study, dict[str, Any]]] = lambda k: next(  # noqa: E731
        develop(SUITE, FOLDER, cases=[k], overrides=CHANGES)
    )
    answers = {
        k: cases.get(f"case {k} peers", lambda k=k: answered_by_peers(*drawn(k), settings))
        for k in counted
    }
    rows = []
    for k in counted:
        ours = cases.get(f"case {k} ours", lambda k=k: _guarded(partial(_ours, *drawn(k))))
        rows.append({**answers[k], "ours": ours})
        told = {w: rows[-1].get(w, {}).get("error") for w in ("ours", *PEERS)}
        print(f"    {rows[-1]['concealed']}: {told}", flush=True)
    return {"settings": vars(settings), **figures(rows)}


if __name__ == "__main__":
    benchmark("peers", run)
