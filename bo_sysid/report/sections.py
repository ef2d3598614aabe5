"""The sections of the page, each made from what a run folder holds; None where it has nothing."""

import itertools
from typing import Any

import pandas as pd

from bo_sysid.errors import BoSysidError, RunError
from bo_sysid.report import interactive, interactive_search
from bo_sysid.report.comparison import comparison, conclusions, sentence
from bo_sysid.report.diagnosis_text import (
    alternatives_table,
    errors_table,
    findings_table,
    undecided_sentences,
    verdict_text,
)
from bo_sysid.report.learning import learning_summary
from bo_sysid.report.look import channel_units, error_units, top_sets, worst_channels, worst_joints
from bo_sysid.report.marked import marked_robot
from bo_sysid.report.parts import Found, Plot, Section, Table
from bo_sysid.report.provenance import PROOF, again, data
from bo_sysid.report.text import compared_table, run_text
from bo_sysid.runs import read_frame, read_json
from bo_sysid.runs.files import inside

_PAIRS = 6
_LARGEST = 300_000  # bytes of a picture in the page
_DONE = {"record": "Recorded.", "conceal": "Concealed; no seal is open yet."}
_CHANNELS = 12  # of a page; all are in the run folder


def headline(found: Found) -> dict[str, Any]:
    """Return the name of the run, its verdict and the sentences that say it all."""
    verdict = _without_result(found)
    try:
        if found.has("diagnosis.json"):
            diagnosis = read_json(found.folder, "diagnosis.json")
            summary = found.summary
            sentences = summary.get("sentences") or [f["sentence"] for f in diagnosis["findings"]]
            return {
                "name": summary.get("name", found.folder.name),
                "verdict": verdict_text(diagnosis, summary),
                "sentences": sentences,
            }
        if found.has("identification.json"):
            made = read_json(found.folder, "identification.json")
            values = [
                f"{p['name']} is {p['value']:.4g} {p['unit']} "
                f"(95 %: {p['low95']:.4g} to {p['high95']:.4g}; the model had {p['nominal']:.4g})."
                for p in made["parameters"]
            ]
            return {
                "name": made["name"],
                "verdict": "The parameters that fit.",
                "sentences": [*values, made["stopped"]],
            }
        if found.has("learning.json"):
            made = read_json(found.folder, "learning.json")
            return {"name": made["name"], **learning_summary(made)}
        if found.has("comparison.json"):
            made = read_json(found.folder, "comparison.json")
            sentences = conclusions(made, found.folder)
            return {"name": made["name"], "verdict": sentence(made), "sentences": sentences}
    except (RunError, AttributeError, LookupError, TypeError, ValueError):
        # the sections say what is damaged
        verdict = "The result cannot be read: a file of the run is damaged."
    try:
        so_far = run_text(found.folder).replace(f"{found.folder / PROOF}", PROOF).splitlines()[1:]
    except RunError:  # told where it is shown
        so_far = []
    return {"name": found.folder.name, "verdict": verdict, "sentences": so_far}


def _without_result(found: Found) -> str:
    """Return the verdict on a run that has no answer: some commands are done without one."""
    if found.has(PROOF):
        return "Seals were opened, and their answers scored."
    try:
        record = read_json(found.folder, "run.json")
        done = record["status"] == "finished" and _DONE.get(record["command"])
    except (RunError, LookupError, TypeError):  # told where it is shown
        done = None
    return done or "No result yet."


def robot(found: Found) -> Section | None:
    """The robot with the guilty sites marked."""
    if not (found.has("diagnosis.json") and found.has("pose.json")):
        return None
    diagnosis = read_json(found.folder, "diagnosis.json")
    pose = read_json(found.folder, "pose.json")
    try:
        posed, sites = marked_robot(inside(found.folder, str(diagnosis["model"])), pose, diagnosis)
    except BoSysidError as error:
        raise RunError(f"the robot cannot be drawn: {error}") from None
    sites_text = "; ".join(w.replace("\n", " ") for _, w in sites) or "no site is marked"
    words = f"The robot in a recorded pose, {sites_text}. Drag to turn it."
    plot = Plot(words, {"": interactive.robot(posed, sites)})
    return Section("robot", "Where", plots=[plot], images=_moving(found))


def _moving(found: Found) -> list[tuple[str, str]]:
    """Return the animation of before and after, where the run has it."""
    name = "figures/before_after.gif"
    if not found.has(name) or (found.folder / name).stat().st_size > _LARGEST:
        return []
    words = (
        "What was recorded (grey) and what the nominal model (left) and the repaired model (right) "
        "forecast for it, in real time, where the nominal model is worst."
    )
    return [(found.picture(name), words)]


def proof(found: Found) -> Section | None:
    """Recorded against predicted on recordings that were never used."""
    if not found.has("diagnosis.json"):
        return None
    holdout = read_json(found.folder, "diagnosis.json")["holdout"]
    plots = []
    if found.has("traces.parquet"):
        traces = read_frame(found.folder, "traces.parquet")
        if len(traces):
            figures = interactive.all_held_out(traces, _units(found), _CHANNELS)
            words = (
                "Above: what was recorded (grey), and what the nominal, the refitted and the "
                "repaired model forecast; each piece starts from the moment before it, nothing "
                "later is used. Below: recorded minus forecast; the repaired model should lie on "
                "zero."
            )
            plots = [Plot(words, figures, "channel")]
    errors = errors_table(holdout)
    tables = [("Errors, root mean square", Table.of(errors))] if len(errors) else []
    if not plots and not tables:
        return Section("proof", "Proof", text=["Nothing was set aside to prove the repair on."])
    return Section("proof", "Proof on recordings that were never used", plots=plots, tables=tables)


def missing_force(found: Found) -> Section | None:
    """Where in time and state the residual sits."""
    if not found.has("forces.parquet"):
        return None
    pieces = read_frame(found.folder, "forces.parquet")
    if pieces.empty:
        return None
    figures = {j: interactive.forces(pieces, j) for j in worst_joints(pieces)[:_CHANNELS]}
    words = (
        "Each dot is a tenth of a second: the force that would have to be added at the joint for "
        "the model to follow the training recording. A step over speed is dry friction, a slope "
        "over speed is damping, a slope over position is a spring. Blue: what the repaired model "
        "still lacks. Both step as finely as the recordings show."
    )
    return Section("forces", "When the mismatch acts", plots=[Plot(words, figures, "joint")])


def explanations(found: Found) -> Section | None:
    """What was found, and what else was tried."""
    if not found.has("diagnosis.json"):
        return None
    diagnosis = read_json(found.folder, "diagnosis.json")
    tables = []
    if diagnosis["findings"]:
        tables.append(("Found", Table.of(findings_table(diagnosis["findings"]))))
    if found.has("sessions.parquet") and len(each := read_frame(found.folder, "sessions.parquet")):
        tables.append(("Recording by recording", Table.of(each)))
    plots = []
    if found.has("sets.parquet"):
        sets = top_sets(read_frame(found.folder, "sets.parquet"))
        words = (
            "What each explanation leaves unexplained in the training recordings, in units of the "
            "sensor noise (dashed: nothing is left but noise), with its probability. "
            "Blue: the answer; light blue: not to be told from it; orange: nothing is missing."
        )
        plots.append(Plot(words, {"": interactive.evidence(sets)}))
    elif diagnosis["alternatives"]:
        tables.append(("Also tried", Table.of(alternatives_table(diagnosis["alternatives"]))))
    text = undecided_sentences(diagnosis["findings"])
    if diagnosis["next_experiment"]:
        text.append(f"What to record next: {diagnosis['next_experiment'].get('sentence', '')}")
    return Section("explanations", "What was found, and what else was tried",
                   text=text, plots=plots, tables=tables)  # fmt: skip


def parameters(found: Found) -> Section | None:
    """The belief over parameters."""
    if not found.has("identification.json"):
        return None
    made = read_json(found.folder, "identification.json")
    table = pd.DataFrame(made["parameters"])
    belief = read_frame(found.folder, "belief.parquet")
    ones = {
        str(p["name"]): interactive_search.marginal(
            belief, str(p["name"]), str(p["unit"]), p["nominal"]
        )
        for p in made["parameters"]
    }
    units = {str(p["name"]): str(p["unit"]) for p in made["parameters"]}
    plots = [Plot("Probability of each value of a parameter. P goes to a point as the search goes "
                  "on; P_boot says how sure these recordings are.", ones, "parameter")]  # fmt: skip
    pairs = list(itertools.combinations(units, 2))[:_PAIRS]
    if pairs:
        figures = {f"{a}, {b}": interactive_search.pair(belief, a, b, units) for a, b in pairs}
        plots.append(Plot("P_boot over two parameters.", figures, "pair"))
    tables = [
        ("Parameters, with 95 % intervals from P_boot", Table.of(table)),
        ("Errors of prediction, root mean square", Table.of(compared_table(made["errors"]))),
    ]
    return Section("parameters", "Parameters", plots=plots, tables=tables)


def identifiability(found: Found) -> Section | None:
    """What the recordings tell about each parameter, and which stand for each other."""
    if not found.has("identification.json"):
        return None
    made = read_json(found.folder, "identification.json")
    if "identifiability" not in made:  # of an earlier version
        return None
    table = pd.DataFrame(made["identifiability"]).rename(
        columns={"of_range": "95 % interval / range", "tied_to": "moves with"}
    )
    text = made["unsure"] or ["These recordings tell every parameter from the others."]
    tables = [("From P_boot, the arg-min over bootstraps of the recordings", Table.of(table))]
    return Section("identifiability", "What these recordings tell", text=text, tables=tables)


def search(found: Found) -> Section | None:
    """The search: deviation and entropy per evaluation."""
    if not found.has("evaluations.parquet"):
        return None
    evaluations = read_frame(found.folder, "evaluations.parquet", ["deviation"])
    if evaluations.empty:
        return None
    words = "The deviation of every candidate that was tried, and what is left to be known."
    plot = Plot(words, {"": interactive_search.progress(evaluations)})
    return Section("search", f"Search: {len(evaluations)} evaluations", plots=[plot])


def predictions(found: Found) -> Section | None:
    """Recorded, nominal and identified on recordings set aside."""
    if not (found.has("identification.json") and found.has("traces.parquet")):
        return None
    traces = read_frame(found.folder, "traces.parquet")
    units = error_units(read_json(found.folder, "identification.json")["errors"])
    worst = worst_channels(traces)[:_CHANNELS]
    figures = {c: interactive.held_out(traces, c, units.get(c, "")) for c in worst}
    words = (
        "Above: recorded (grey), nominal and identified model on the recording that was set aside. "
        "Below: recorded minus forecast."
    )
    return Section("predictions", "Predictions", plots=[Plot(words, figures, "channel")])


def learned(found: Found) -> Section | None:
    """The policies' returns against real trajectories."""
    if not found.has("iterations.parquet"):
        return None
    iterations = read_frame(found.folder, "iterations.parquet")
    if iterations.empty:
        return None
    beside = " and on the plant" if iterations["plant_return"].notna().any() else ""
    words = f"Return of the policy after each round, on the identified model{beside}."
    plots = [Plot(words, {"": interactive_search.learning(iterations)})]
    if found.has("training.parquet"):
        training = read_frame(found.folder, "training.parquet")
        words = (
            "How each policy was learned: mean reward of a batch in the identified model times the "
            "steps of an episode, against simulated control steps. One curve a round; no step of "
            "the plant is in them."
        )
        plots.append(Plot(words, {"": interactive_search.training(training)}))
    shown = [c for c in iterations if iterations[c].notna().any() and _flat(iterations[c])]
    tables = [("Rounds", Table.of(iterations[shown]))]
    return Section("learning", "Learning", plots=plots, tables=tables)


MAKERS = (
    robot, proof, missing_force, explanations, parameters, identifiability, predictions, search,
    learned, comparison, data, again,
)  # fmt: skip
"""The sections in the order of the page."""


def _units(found: Found) -> dict[str, str]:
    """Return the units of the position channels, as far as the run tells them."""
    try:
        return channel_units(read_frame(found.folder, "forces.parquet"))
    except RunError:
        return {}


def _flat(column: pd.Series) -> bool:
    """Return whether the cells of a column can be shown in a table."""
    return bool(column.map(lambda v: isinstance(v, str | int | float | bool)).all())
