"""The study: one declarative YAML file, from which everything runs."""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, PrivateAttr, ValidationError

from bo_sysid.errors import ModelError, StudyError, nearest
from bo_sysid.runs import digest
from bo_sysid.study import named
from bo_sysid.study import source as text
from bo_sysid.study.base import Relocation, Section
from bo_sysid.study.bounds import require_apart, require_bounds, require_one_step, require_si
from bo_sysid.study.messages import study_error
from bo_sysid.study.outer import (
    Compare,
    Diagnosis,
    Execution,
    Learn,
    Limit,
    Plant,
    Policy,
    Task,
)
from bo_sysid.study.sections import (
    ActuatorLaw,
    Deviation,
    ModelSource,
    ParameterEntry,
    Recordings,
    Search,
)
from bo_sysid.study.source import KeyPath, Source, matching

if TYPE_CHECKING:
    from bo_sysid.mjcf import Model
    from bo_sysid.parameters import Parameter


def _model(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


class Study(Section):
    """A study as resolved: every key of the file, defaults filled in.

    Make one with `Study.load` or `Study.from_dict`; both raise `StudyError` with every problem in
    one message.
    """

    version: Literal[1] = 1
    """Version of the format of study files."""
    name: str = ""
    """What the study is about; the name of the file where left out."""
    model: Annotated[ModelSource, BeforeValidator(_model, json_schema_input_type=str | ModelSource)]
    """The nominal model: an MJCF file, or where else it comes from."""
    recordings: Recordings
    """Recordings of the real machine."""
    actuators: Mapping[str, ActuatorLaw] = {}
    """By the actuator's name, what MJCF cannot say about it."""
    parameters: tuple[ParameterEntry, ...] = ()
    """What is uncertain but modelled."""
    deviation: Deviation = Deviation()
    """How models are compared with the recordings."""
    search: Search = Search()
    """How the best candidate is searched."""
    diagnosis: Diagnosis = Diagnosis()
    """Which missing physics is looked for."""
    limits: Mapping[str, Limit] = {}
    """By the joint's name, bounds of every excitation or policy meant for the machine."""
    task: Task | None = None
    """What a policy is learned for."""
    policy: Policy = Policy()
    """How a policy is learned."""
    learn: Learn = Learn()
    """The outer loop."""
    compare: Compare = Compare()
    """Comparison of ways to search."""
    execution: Execution = Execution()
    """Where jobs run."""
    plant: Plant | None = None
    """A simulated machine to record from."""

    _folder: Path = PrivateAttr(default=Path())
    _source: Source = PrivateAttr(default=Source("study", {}))

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Mapping[str, Any] | None = None,
        *,
        trust_code: bool = False,
    ) -> "Study":
        """Read a study file.

        Args:
            path: the YAML file; paths in it are relative to its folder.
            overrides: values by dotted key that replace what the file says, such as
                ``{"search.budget": 20, "parameters.0.low": 0.1}``.
            trust_code: allow the study to name Python files, which run when they are needed.

        Raises:
            StudyError: the file is missing or wrong; the message lists every problem with its
                line, key and nearest valid choice.
        """
        path = Path(path)
        return cls._make(text.read(path, overrides or {}), path.parent, path.stem, trust_code)

    @classmethod
    def from_dict(
        cls, data: Mapping[str, Any], folder: str | Path = ".", *, trust_code: bool = False
    ) -> "Study":
        """Make a study from a mapping as in a study file; paths are relative to `folder`.

        Raises:
            StudyError: something in it is wrong.
        """
        return cls._make(Source("study", dict(data)), Path(folder), "study", trust_code)

    @classmethod
    def _make(cls, source: Source, folder: Path, name: str, trust_code: bool) -> "Study":
        try:
            study = cls.model_validate({"name": name, **source.data})
        except ValidationError as error:
            raise study_error(error, source, cls) from None
        study._folder, study._source = folder, source
        study._check_code(trust_code)
        if study.model.file is not None:
            study.file(study.model.file, ("model",))
        return study

    @property
    def folder(self) -> Path:
        """The folder that paths in the study are relative to."""
        return self._folder

    @property
    def train_files(self) -> tuple[Path, ...]:
        """The files of `recordings.train`, globs expanded; empty where a dataset is named.

        Raises:
            StudyError: a name or glob matches no file.
        """
        return self._files("train")

    @property
    def holdout_files(self) -> tuple[Path, ...]:
        """The files of `recordings.holdout`, globs expanded; empty where there are none.

        Raises:
            StudyError: a name or glob matches no file, or a file is used for training as well.
        """
        files = self._files("holdout")
        trained = {file.resolve() for file in self._files("train")}
        both = [file.name for file in files if file.resolve() in trained]
        if both:
            raise self.error(
                ("recordings", "holdout"), f"{min(both)} is among the files of train as well"
            )
        return files

    def file(self, path: str, key: KeyPath) -> Path:
        """Return where a file named by the study is.

        Raises:
            StudyError: there is no such file; the message names the nearest in its folder.
        """
        full = self._folder / path
        if not full.is_file():
            raise self.error(key, f"no file {path!r} in {self._folder}; {_near(full)}")
        return full

    def files(self, pattern: str, key: KeyPath) -> list[Path]:
        """Return the files that a name or glob of the study matches.

        Raises:
            StudyError: there is none; the message names the nearest.
        """
        return self._matching(pattern, key, Path.is_file)

    def parameter_set(self, model: "Model") -> "tuple[Parameter, ...]":
        """Return the parameters, with wildcards matched to what `model` has.

        Raises:
            StudyError: an address is none, matches nothing or is the time step, two parameters have
                one name or number of the model, one has the name of a column of the tables, a unit
                is no SI unit, or the model does not compile at a bound.
        """
        from bo_sysid.mjcf import Address
        from bo_sysid.parameters import COLUMNS, Parameter

        found: dict[str, Parameter] = {}
        entries: dict[str, int] = {}
        for i, entry in enumerate(self.parameters):
            if entry.name in COLUMNS:
                raise self.error(
                    ("parameters", i, "name"),
                    f"{entry.name!r} is a column of the tables that are written; choose another "
                    f"name, none of {', '.join(COLUMNS)}",
                )
            require_si(self, i)
            try:
                matched = [m for a in entry.address for m in Address.parse(a).matches(model)]
            except ModelError as error:
                raise self.error(("parameters", i, "address"), str(error)) from None
            name = entry.name or ", ".join(entry.address)
            groups = {name: tuple(matched)}
            if entry.each:
                groups = {f"{entry.name} {m}" if entry.name else m: (m,) for m in matched}
            for name, addresses in groups.items():
                if name in found:
                    raise self.error(
                        ("parameters", i), f"there is another parameter {name!r}; name one of them"
                    )
                entries[name] = i
                found[name] = Parameter(
                    name,
                    addresses,
                    low=entry.low,
                    high=entry.high,
                    steps=entry.steps,
                    apply=entry.apply,
                    unit=entry.unit,
                    ordered=entry.ordered is not False,
                )
        parameters = tuple(found.values())
        require_one_step(self, parameters, entries)
        require_apart(self, model, parameters, entries)
        require_bounds(self, model, parameters, entries)
        return parameters

    def resolved(
        self, relative_to: str | Path | None = None, *, defaults: bool = True
    ) -> dict[str, Any]:
        """Return the study with all defaults, as a mapping for YAML or JSON.

        Args:
            relative_to: folder that relative paths shall be relative to, where the mapping is
                written to another folder than the study's.
            defaults: whether keys at their defaults are there as well.
        """
        move = None
        if relative_to is not None:
            move = Relocation(self._folder.resolve(), Path(relative_to).resolve())
        left_out = not defaults
        return self.model_dump(
            mode="json", exclude_none=True, exclude_defaults=left_out, context=move
        )

    @property
    def sha256(self) -> str:
        """Hash of the resolved study, as canonical JSON."""
        return digest(self.resolved())

    def error(self, key: KeyPath, message: str) -> StudyError:
        """Return an error about a key, with the file and the line that sets it."""
        return self._source.error(key, message)

    def check_names(
        self,
        *,
        acquisitions: Iterable[str] | None = None,
        choices: Iterable[str] | None = None,
        stops: Iterable[str] | None = None,
        effects: Iterable[str] | None = None,
        datasets: Iterable[str] | None = None,
    ) -> None:
        """Check names against what is registered; a list that is left out is not checked.

        Tasks of dm_control are checked by the suite itself, where they are loaded.

        Args:
            acquisitions: names for `search.acquisition` and the arms of a comparison.
            choices: names for `learn.choose` and the arms.
            stops: names for `learn.stop` and the arms.
            effects: effect ids.
            datasets: names of public datasets.

        Raises:
            StudyError: a name is not registered; the message has the nearest one.
        """
        registered = {
            "acquisition": acquisitions,
            "choice": choices,
            "stop rule": stops,
            "effect": effects,
            "dataset": datasets,
        }
        valid = {kind: set(names) for kind, names in registered.items() if names is not None}
        for kind, key, name in named.names(self):
            if kind in valid and name not in valid[kind]:
                raise self.error(key, f"unknown {kind} {name!r}; {nearest(name, valid[kind])}")

    @property
    def code(self) -> dict[str, KeyPath]:
        """The Python files that the study names, each with the key that names it."""
        return dict(named.code(self))

    def _check_code(self, trusted: bool) -> None:
        for file, key in self.code.items():
            if not trusted:
                raise self.error(
                    key,
                    f"names Python code ({file}), which runs only with --trust-code "
                    "(trust_code=True in Python): read it first",
                )
            self.file(file, key)

    def _matching(
        self, pattern: str, key: KeyPath, wanted: Callable[[Path], bool], hint: str = ""
    ) -> list[Path]:
        """Return what a pattern matches and is wanted; there must be something."""
        try:
            files = [p for p in matching(self._folder, pattern) if wanted(p)]
        except StudyError as error:
            raise self.error(key, str(error)) from None
        if not files:
            raise self.error(
                key, f"{pattern!r} matches no file; {_near(self._folder / pattern)}{hint}"
            )
        return files

    def _files(self, part: Literal["train", "holdout"]) -> tuple[Path, ...]:
        found: dict[Path, Path] = {}
        for i, pattern in enumerate(getattr(self.recordings, part) or ()):
            made = "; bo-sysid record makes recordings of its plant" if self.plant else ""
            key = ("recordings", part, i)
            for file in self._matching(pattern, key, _is_log, made):
                found.setdefault(file.resolve(), file)  # one file, however it is spelled
        return tuple(found.values())


def _is_log(path: Path) -> bool:
    """Whether a path is a file, or a folder that holds recordings."""
    if not path.is_dir():
        return path.is_file()
    from bo_sysid.recording.formats import log_folder

    return log_folder(path) is not None


def _near(path: Path) -> str:
    """Return the files nearest to a path that is no file, from its nearest folder."""
    path = Path(os.path.normpath(path))
    if path.is_dir():
        return "it is a folder; name the files in it, for instance with *.csv"
    folder = next((p for p in path.parents if p.is_dir()), Path())
    files = [p.name for p in folder.iterdir()] if folder == path.parent else []
    missing = path.relative_to(folder).parts[0]
    return f"in {folder}: {nearest(missing, files)}" if files else f"no {missing} in {folder}"
