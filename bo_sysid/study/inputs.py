"""From a study to its model and its recordings."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from bo_sysid.effects import Effect, Part, Reading, catalogue
from bo_sysid.effects.beside import as_commanded_and_measured, read_beside
from bo_sysid.effects.readings import readings
from bo_sysid.errors import ModelError, RecordingError, UserError, nearest
from bo_sysid.execution.files import run_file
from bo_sysid.mjcf import Model
from bo_sysid.recording import ColumnRule, Recording, load_dataset, read_recordings
from bo_sysid.recording.value import kind_of, wrong_name
from bo_sysid.runs import versions
from bo_sysid.study.requirements import known_channels
from bo_sysid.study.rules import clock_rules, column_rules
from bo_sysid.study.study import Study

_MOTION = ("qpos", "qvel")
_LEAST = 2  # samples of a channel that a part must have
TRAINED_SHARE = 0.75  # of the time of each recording, where the study names no hold-out


def load_model(study: Study) -> Model:
    """Return the nominal model of a study.

    Raises:
        ModelError: it does not compile, or there is no such robot.
        StudyError: there is no such file or task, or it lacks what a key of the study names.
    """
    try:
        return _model(study)
    except ModelError as error:
        if study.model.dm_control is not None:
            raise study.error(("model", "dm_control"), str(error)) from None
        if error.key:
            raise study.error(("model", error.key), str(error)) from None
        raise


def _model(study: Study) -> Model:
    source = study.model
    if source.dm_control is not None:
        return Model.from_dm_control(source.dm_control.domain, source.dm_control.task)
    base, hold, unrecorded = source.base, source.hold, source.unrecorded
    if source.menagerie is not None:
        robot = source.menagerie
        return Model.from_menagerie(robot, base=base, hold=hold, unrecorded=unrecorded)
    assert source.file is not None  # noqa: S101 - the study has exactly one source
    file = study.file(source.file, ("model",))
    return Model.from_file(file, base=base, hold=hold, unrecorded=unrecorded)


def held_notes(study: Study) -> tuple[str, ...]:
    """Return what the models that a run writes lack of the study's own, in words."""
    gone = [f"joint {name}" for name in study.model.hold]
    gone += ["the free joint of the base"] if study.model.base == "fixed" else []
    if not gone:
        return ()
    own = study.model.file or study.model.menagerie
    return (
        f"The model that is written lacks what was held, with what drives it: {', '.join(gone)}. "
        f"What was found can be put into {own} as it stands in the tables.",
    )


def load_parts(study: Study, model: Model) -> tuple[Part, ...]:
    """Return what stands beside the model of a study: forces, filters and readings.

    Files are listed in the order in which they were found. A later reading was found in recordings
    of which the earlier was undone: the machine's channels show R₁(R₂(p)), each of a file as a
    whole, and `readings` takes what is nearest to p first. Filters act on commands in the order of
    the files.

    Raises:
        ModelError: a file is none that a diagnosis wrote.
    """
    if not study.model.beside:
        return ()
    compiled, effects = model.compile(), study_effects(study)
    files = (study.file(f, ("model", "beside")) for f in study.model.beside)
    found = [read_beside(f, compiled).parts(model, effects) for f in files]
    others = [p for parts in found for p in parts if not isinstance(p, Reading)]
    shown = [r for parts in reversed(found) for r in readings(parts).values()]
    return (*others, *shown)


def study_effects(study: Study) -> Mapping[str, Effect]:
    """Return the effects that a study can name: the catalogue and those of its own files.

    Raises:
        StudyError: one of its files cannot be loaded.
    """
    key = ("diagnosis", "effect_files")
    return catalogue(study.file(f, key) for f in study.diagnosis.effect_files)


def load_train(study: Study, *, strict: bool = False) -> tuple[Recording, ...]:
    """Return the recordings that a study fits to.

    Where the study names no hold-out, the last quarter of each recording is set aside, and the
    recording's notes say so.

    Args:
        study: names the recordings.
        strict: refuse gaps, jitter, duplicate stamps and outliers.

    Raises:
        RecordingError: a file cannot be read or is wrong.
        StudyError: a pattern matches no file.
    """
    return corrected(study, read_train(study, strict=strict))


def read_train(study: Study, *, strict: bool = False) -> tuple[Recording, ...]:
    """Return the recordings of `load_train` as the machine told them, see `corrected`.

    Raises:
        RecordingError: a file cannot be read or is wrong.
        StudyError: a pattern matches no file.
    """
    if study.recordings.dataset is not None:
        return load_dataset(study.recordings.dataset).train
    whole = read_files(study, study.train_files, strict)
    if study.recordings.holdout is not None:
        return whole
    return tuple(_part(r, train=True) for r in whole)


def require_holdout(study: Study) -> None:
    """Refuse a hold-out that is not there, before long work; nothing of it is read.

    Raises:
        StudyError: a pattern matches no file, or a file is used for training as well.
    """
    if study.recordings.dataset is None:
        _ = study.holdout_files


def load_holdout(study: Study, *, strict: bool = False) -> tuple[Recording, ...]:
    """Return the recordings that a study sets aside; to be called once the answer is frozen.

    Raises:
        RecordingError: a file cannot be read or is wrong.
        StudyError: a pattern matches no file.
    """
    if study.recordings.dataset is not None:
        return corrected(study, load_dataset(study.recordings.dataset).holdout)
    if study.recordings.holdout is not None:
        return corrected(study, read_files(study, study.holdout_files, strict))
    whole = read_files(study, study.train_files, strict)
    return corrected(study, [_part(r, train=False) for r in whole])


def corrected(study: Study, recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Return recordings as the model is to see them: after what stands beside it.

    Commands are filtered and readings undone; without either they are returned as they are.

    Raises:
        ModelError: a file beside the model is none that a diagnosis wrote.
    """
    if not study.model.beside:
        return tuple(recordings)
    model = load_model(study)
    parts, step = load_parts(study, model), float(model.compile().opt.timestep)
    return tuple(as_commanded_and_measured(r, parts, step) for r in recordings)


def fingerprints(study: Study, *, recorded: bool) -> dict[str, str]:
    """Return hashes of what results depend on beside the text of a study, by what they are of.

    "the model" with its meshes and height fields; by name every file beside it and with code.

    Args:
        study: names them.
        recorded: whether its training recordings matter, by name; a dataset is not hashed.

    Raises:
        ModelError: the model does not compile, or there is no such model.
        StudyError: a pattern matches no file.
    """
    files = {file: study.folder / file for file in (*study.code, *study.model.beside)}
    if recorded:
        files |= {os.path.relpath(file, study.folder): file for file in study.train_files}
    return {"the model": load_model(study).sha256, **{n: _content(f) for n, f in files.items()}}


def made_from(study: Study, *, strict: bool) -> dict[str, Any]:
    """Return all that a result depends on beside the study's text and the hold-out.

    Args:
        study: names the files.
        strict: whether messy recordings are refused.
    """
    files = fingerprints(study, recorded=True)
    return {"files": files, "versions": versions(), "strict": strict}


def holdout_hashes(study: Study) -> dict[str, str]:
    """Return hashes of the files of the hold-out by name; a dataset is not hashed.

    Raises:
        StudyError: a pattern matches no file.
    """
    return {os.path.relpath(f, study.folder): _content(f) for f in study.holdout_files}


def _content(path: Path) -> str:
    """Return a hash of a file, or of all files of a folder with their names, as of a bag."""
    digest = hashlib.sha256()
    for file in sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]:
        with open(file, "rb") as opened:
            content = hashlib.file_digest(opened, "sha256").hexdigest()
        digest.update(f"{file.relative_to(path)} {content}\n".encode())
    return digest.hexdigest()


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return the first of what differs between two `fingerprints`; empty where nothing does."""
    return next((n for n in {**before, **now} if before.get(n) != now.get(n)), "")


def load_function(study: Study, reference: str) -> Callable[..., Any]:
    """Return a function (or a class) that a study names as ``<file>.py:<function>``.

    The study was loaded with code trusted, or it would not have been made.

    Raises:
        StudyError: the file has no such function, or running it raises.
    """
    file, _, name = reference.rpartition(":")
    module = load_module(study, file)
    function = getattr(module, name, None)
    if not callable(function):
        found = [n for n in vars(module) if callable(getattr(module, n)) and not n.startswith("_")]
        raise study.error(
            study.code.get(file, ()),
            f"{file} has no function or class {name!r}; {nearest(name, found)}",
        )
    return function  # type: ignore[no-any-return]


def load_module(study: Study, file: str) -> ModuleType:
    """Run a Python file that a study names, such as one with effects, and return it as a module.

    Raises:
        StudyError: there is no such file, or running it raises.
    """
    key = study.code.get(file, ())
    path = study.file(file, key)
    try:
        return run_file(path)
    except UserError:
        raise
    except Exception as error:  # whatever it is, it is for the file's author
        raise study.error(key, f"{file} fails: {type(error).__name__}: {error}") from error


def read_files(study: Study, files: Sequence[Path], strict: bool) -> tuple[Recording, ...]:
    """Return the recordings in files, read with the study's rules for columns and clocks.

    Raises:
        RecordingError: a file cannot be read or is wrong.
        StudyError: a rule says nothing of its channel, or has an unknown unit.
    """
    columns, clocks = column_rules(study), clock_rules(study)
    sources = _sources_alone(study, columns)
    found = [(f, r) for f in files for r in read_recordings(f, columns, clocks, strict, sources)]
    return tuple(_without_held(r, study.model.hold) for r in _named_apart(found))


def _sources_alone(study: Study, rules: Mapping[str, ColumnRule]) -> set[str]:
    """Return columns that a rule reads another channel from and that the model does not name.

    A log may call a column qpos.elbow_deg, of which the study says that it is qpos.elbow.
    """
    named = {r.source for r in rules.values() if r.source and not wrong_name(r.source)}
    if not named - set(rules):
        return set()
    known = known_channels(load_model(study))
    return {s for s in named - set(rules) if s not in known.get(kind_of(s), (s,))}


def _named_apart(found: Sequence[tuple[Path, Recording]]) -> Iterator[Recording]:
    """Yield recordings, those of files that are called alike with the names of their folders."""
    times = Counter(r.name for _, r in found)
    for file, recording in found:
        alike = times[recording.name] > 1
        name = f"{file.parent.name}/{recording.name}" if alike else recording.name
        yield replace(recording, name=name)


def _without_held(recording: Recording, held: Sequence[str]) -> Recording:
    """Return a recording without the motion of joints that the study takes out of the model."""
    motion = {f"{kind}.{joint}" for kind in _MOTION for joint in held}
    unused = [n for n in recording.channels if n in motion]
    if not unused:
        return recording
    channels = {n: c for n, c in recording.channels.items() if n not in unused}
    notes = [f"{n} is not used: its joint is held where the model puts it." for n in unused]
    return replace(recording, channels=channels).with_notes(notes)


def _part(recording: Recording, *, train: bool) -> Recording:
    start, stop = recording.span
    split = start + TRAINED_SHARE * (stop - start)
    if train:
        _require_both_parts(recording, split)
        note = (
            f"{recording.name}: no hold-out is named; the last quarter, from {split:g} s on, is "
            "set aside"
        )
        return recording.between(start, split).with_notes([note])
    return recording.between(split, stop + 1.0)


def _require_both_parts(recording: Recording, split: float) -> None:
    """Refuse a channel that ends before what is set aside, before long work.

    Where all do the log is too short, which is told by what needs it to be longer.
    """
    measured = {n: c for n, c in recording.channels.items() if not c.continuous}
    left = {n: int((c.time >= split).sum()) for n, c in measured.items()}
    short = [n for n, count in left.items() if count < _LEAST]
    if short and len(short) < len(left):
        last = float(measured[short[0]].time[-1])
        raise RecordingError(
            f"{recording.name}: channel {short[0]!r} ends at {last:g} s, and what is from "
            f"{split:g} s on, the last quarter, is set aside since the study names no hold-out; "
            "name one under recordings: holdout, or leave that channel out"
        )
