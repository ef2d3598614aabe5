"""`init`: from a model and logs to a study that can be checked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import mujoco
import pandas as pd

from bo_sysid.errors import RecordingError, UserError
from bo_sysid.mjcf import Loops, Model
from bo_sysid.mjcf.edits import MotorEdit
from bo_sysid.mjcf.joints import FREE, SCALAR
from bo_sysid.recording import RawTable, read_tables
from bo_sysid.runs import atomic
from bo_sysid.starter.behaviour import agrees, by_behaviour
from bo_sysid.starter.blanks import skipping
from bo_sysid.starter.columns import spoilt
from bo_sysid.starter.guess import Rules, guess_rules, read
from bo_sysid.starter.pose import pose_guesses
from bo_sysid.starter.reading import constant_hint, without_constant
from bo_sysid.starter.scales import joint_scales
from bo_sysid.starter.signs import constants_told
from bo_sysid.starter.supply import with_supply
from bo_sysid.starter.write import relative, study_text

_MODELS = (".xml", ".mjcf", ".urdf")


@dataclass(frozen=True)
class Started:
    """A study that was written.

    Attributes:
        path: of the study.
        rules: how its logs are read, with the reasons.
        notes: what else was decided.
    """

    path: Path
    rules: Rules
    notes: tuple[str, ...]


def init(
    model: str | Path, logs: Sequence[str | Path], out: str | Path, *, rate: float = 0.0
) -> Started:
    """Write a commented study from a model and logs.

    Args:
        model: an MJCF or URDF file.
        logs: files or folders; all of one machine and one format.
        out: the study file to be written, which must not exist.
        rate: rows of the logs per second in [Hz], where no column stamps them; else 0.

    Raises:
        UserError: the study exists, the rate is not positive, a file cannot be read or is named
            twice, a log has no clock, or the model no hinge and no slide.
    """
    out, source = Path(out), Path(model)
    if out.exists():
        raise UserError(f"{out}: exists; name another file with --out, or remove it")
    files = _different([Path(log) for log in logs])
    _require_model_first(source, files)
    held = max(len(files) // 4, 1) if len(files) > 1 else 0
    train, holdout = files[: len(files) - held], files[len(files) - held :]
    tables = _require_same_columns([t for f in train for t in _read(f, rate)])
    _require_same_columns([*tables[:1], *(t for f in holdout for t in _read(f, rate))])
    whole, notes, fixed = _held_base(source, tables[0])
    motors, edits = out.with_name(f"{out.stem}_motors.xml"), _motors(whole)
    if edits and motors.exists():
        raise UserError(
            f"{motors}: exists, where the model with motors belongs; remove it, or name another "
            "study with --out"
        )
    kept, rules, scales, hints = _guessed(
        source, whole, edits, tables, "fixed" if fixed else "free"
    )
    notes += _motor_notes(source, motors, edits, kept)
    if not_found := rules.to_fill_in:
        notes.append(f"No column was found for: {', '.join(not_found)}. Fill in what is marked.")
        if kept and len(rules.unmatched) == len(kept):
            notes.append(
                f"If nothing drives the machine, write model: {relative(source, out.parent)} and "
                "remove the lines of ctrl."
            )
    if not_found or rules.held:
        notes += [f"{sentence}." for sentence in spoilt(tables[0])]
    out.parent.mkdir(parents=True, exist_ok=True)
    text = study_text(
        source.stem,
        relative(motors if kept else source, out.parent),
        [relative(f, out.parent) for f in train],
        [relative(f, out.parent) for f in holdout],
        rules,
        scales,
        hints,
        base_fixed=fixed,
        notes=notes,
    )
    if kept:  # not before all else is known to fit
        whole.export(motors, kept)
    with atomic(out) as beside:
        beside.write_text(text, encoding="utf-8")
    return Started(out, rules, tuple(notes))


def _read(file: Path, rate: float) -> list[RawTable]:
    """Return the tables of a log, whose rows are counted where a rate is stated."""
    if not (math.isfinite(rate) and rate >= 0):
        raise UserError(f"--rate is {rate:g}; it must be a positive number of rows per second")
    return [t.counted(rate) if rate else t for t in read_tables(file)]


def _require_model_first(model: Path, logs: Sequence[Path]) -> None:
    """Raise where a model stands among the logs, and a log in its place."""
    others = [f for f in logs if f.suffix.lower() in _MODELS]
    if others and model.suffix.lower() not in _MODELS:
        raise UserError(
            f"{model}: the model comes first, then the logs: bo-sysid init {others[0]} {model} …"
        )


def _different(files: list[Path]) -> list[Path]:
    """Return the files, of which none may be named twice."""
    for k, file in enumerate(files):
        if file.resolve() in [f.resolve() for f in files[:k]]:
            raise UserError(
                f"{file}: named twice; a log that is fitted to cannot be the one that is held out, "
                "so name each once"
            )
    return files


def _guessed(
    source: Path,
    whole: Model,
    edits: Sequence[MotorEdit],
    tables: Sequence[RawTable],
    base: Literal["free", "fixed"],
) -> tuple[Sequence[MotorEdit], Rules, pd.DataFrame, dict[str, str]]:
    """Return motors, the rules that read the tables on a model with them, its scales, and hints.

    Of the motors that no column tells about none is left where one tells about others, nor where no
    column is left that could and the motion is that of a machine which nothing drives.
    """
    with TemporaryDirectory() as spare:
        read_from, nominal = source, whole
        if edits:
            read_from = Path(spare) / f"{source.stem}.xml"
            whole.export(read_from, edits)
            nominal = Model.from_file(read_from)
        rules = skipping(guess_rules(nominal, tables[0]), tables)
        if rules.held or rules.following:
            free, follow = nominal.controlled, dict.fromkeys(rules.following)
            nominal = Model.from_file(read_from, base=base, hold=rules.held, unrecorded=follow)
            rules = rules.without_controls(set(free) - set(nominal.controlled))
        if rules.missing:
            return edits, rules, pd.DataFrame(), {}
        rules = by_behaviour(nominal, tables, rules)
        recognised = [e for e in edits if e.joint not in rules.unmatched]
        if edits and not (recognised or rules.unused):
            undriven = _guessed(source, whole, (), tables, base)
            if any(agrees(g) for n, g in undriven[1].guesses.items() if n.startswith("qpos.")):
                return undriven
        if any(f"ctrl.{e.joint}" in rules.columns for e in recognised) and len(recognised) < len(
            edits
        ):
            return _guessed(source, whole, recognised, tables, base)
        rules = with_supply(tables, rules)
        recordings = [read(t, rules) for t in tables]
        scales = joint_scales(nominal, recordings)
        hints = _hints(nominal, tables[0], rules)
        bare = [n for n in hints if "scale" not in rules.columns[n]]
        if bare:
            known = constants_told(nominal.compile(), recordings)
            bare = [n for n in bare if not (agrees(rules.guesses[n]) and n in known)]
        marked = {n: without_constant(rules.guesses[n]) for n in bare}
        return edits, replace(rules, guesses={**rules.guesses, **marked}), scales, hints


def _hints(model: Model, table: RawTable, rules: Rules) -> dict[str, str]:
    """Return by channel what is to be known of it beside its rule."""
    compiled, hints = model.compile(), {}
    for actuator in model.controlled:
        rule = rules.columns.get(f"ctrl.{actuator}", {})
        stated = table.units.get(rule.get("from", f"ctrl.{actuator}"), "")
        hint = constant_hint(compiled, actuator, rule.get("unit") or stated)
        if hint:
            hints[f"ctrl.{actuator}"] = hint
    return hints


def _require_same_columns(tables: list[RawTable]) -> list[RawTable]:
    """Return the tables, which must have the columns of the first."""
    for table in tables[1:]:
        missing = set(tables[0].columns) ^ set(table.columns)
        if missing:
            raise RecordingError(
                f"{table.source}: its columns differ from those of {tables[0].source} "
                f"({', '.join(sorted(missing)[:6])}); init takes logs of one format"
            )
    return tables


def _held_base(source: Path, table: RawTable) -> tuple[Model, list[str], bool]:
    """Return the model; a floating base that no column tells about is held."""
    model = Model.from_file(source)
    compiled = model.compile()
    free = [n for n in model.joints if int(compiled.joint(n).type[0]) == FREE]
    free_columns = [c for c in table.columns if any(f in c for f in free)]
    if not free or free_columns or pose_guesses(compiled, table):
        return model, [], False
    note = (
        f"No column was found for the pose of the base ({', '.join(free)}), which is held where "
        "the model puts it: right for a robot on a stand, wrong for one that drives or walks."
    )
    return Model.from_file(source, base="fixed"), [note], True


def _motors(model: Model) -> list[MotorEdit]:
    """Return edits that give a model without actuators (as every URDF) motors.

    Each joint has one but those that follow from others, as a finger that mimics another.
    """
    if model.actuators:
        return []
    compiled = model.compile()
    equal = compiled.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    mimics = [compiled.joint(int(j)).name for j in compiled.eq_obj1id[equal]]
    following = Loops.of(compiled, mimics).joints
    return [
        MotorEdit(n)
        for n in model.joints
        if int(compiled.joint(n).type[0]) in SCALAR and n not in following
    ]


def _motor_notes(
    source: Path, motors: Path, edits: Sequence[MotorEdit], kept: Sequence[MotorEdit]
) -> list[str]:
    """Return what is to be said of motors that a model was given."""
    if not edits:
        return []
    if not kept:
        return [
            f"{source.name} has no actuators, no column is left that could say what drives it, and "
            "it moves as if nothing did: it got no motors."
        ]
    notes = [
        f"{source.name} has no actuators: {motors.name} has a motor of 1 N m (N) for "
        f"{', '.join(e.joint for e in kept)}."
    ]
    if without := [e.joint for e in edits if e not in kept]:
        notes.append(
            f"No column was found for what drives {', '.join(without)}, which got no motor: right "
            f"for joints that hang free. If a column says it, add a motor to {motors.name}."
        )
    return notes
