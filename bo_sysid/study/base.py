"""What all sections of a study file have in common."""

import glob
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)


class Section(BaseModel):
    """A frozen part of a study; an unknown key is an error, one with nothing behind it left out.

    The docstring of a field is its description in the JSON Schema.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        validate_by_alias=True,
        validate_by_name=True,
        serialize_by_alias=True,
    )

    @model_validator(mode="before")
    @classmethod
    def _without_empty(cls, data: Any) -> Any:
        """Leave out known keys without a value, as of a list whose entries were all removed."""
        if not isinstance(data, Mapping):
            return data
        known = {name for n, f in cls.model_fields.items() for name in (n, f.alias)}
        return {k: v for k, v in data.items() if v is not None or k not in known}


@dataclass(frozen=True)
class Relocation:
    """Rewrites the relative paths of a study when it is written to another folder."""

    source: Path
    target: Path

    def __call__(self, path: str) -> str:
        """Return `path`, relative to `source`, as it is seen from `target`."""
        if os.path.isabs(path):
            return path
        return Path(os.path.relpath(self.source / path, self.target)).as_posix()

    def pattern(self, pattern: str) -> str:
        """Return a file or pattern as it is seen from `target`.

        What stands before a pattern is no part of it: a folder there may be called ``st[1]``.
        """
        if (
            os.path.isabs(pattern)
            or not glob.has_magic(pattern)
            or (self.source / pattern).exists()  # such as "run [1].csv", which is no pattern
        ):
            return self(pattern)
        folder, parts = self.source, list(Path(os.path.normpath(pattern)).parts)
        while parts and parts[0] == "..":
            folder, parts = folder.parent, parts[1:]
        before = glob.escape(Path(os.path.relpath(folder, self.target)).as_posix())
        return Path(before, *parts).as_posix()


def _relocate(path: str, info: Any) -> str:  # info: pydantic.SerializationInfo
    return info.context(path) if isinstance(info.context, Relocation) else path


def _relocate_pattern(pattern: str, info: Any) -> str:
    moves = isinstance(info.context, Relocation)
    return info.context.pattern(pattern) if moves else pattern


def _relocate_code(reference: str, info: Any) -> str:
    file, _, name = reference.rpartition(":")
    return f"{_relocate(file, info)}:{name}"


def _code(value: str) -> str:
    file, _, name = value.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        raise ValueError(f"must be <file>.py:<name>, as in servo.py:duty, not {value!r}")
    return value


def _no_bool(value: Any) -> Any:
    # YAML reads yes, no, on and off as booleans, which Python counts as 1 and 0
    if isinstance(value, bool):
        raise ValueError(f"must be a number, not {'true' if value else 'false'}")
    return value


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Real = Annotated[float, BeforeValidator(_no_bool)]
Positive = Annotated[float, Field(gt=0), BeforeValidator(_no_bool)]
NotNegative = Annotated[float, Field(ge=0), BeforeValidator(_no_bool)]
Count = Annotated[int, Field(ge=1), BeforeValidator(_no_bool)]
Several = Annotated[int, Field(ge=2), BeforeValidator(_no_bool)]
Seed = Annotated[int, Field(ge=0), BeforeValidator(_no_bool)]
Name = Annotated[str, Field(min_length=1)]

FilePath = Annotated[str, Field(min_length=1), PlainSerializer(_relocate)]
"""A path relative to the study file."""

Pattern = Annotated[str, Field(min_length=1), PlainSerializer(_relocate_pattern)]
"""A path or glob relative to the study file."""

CodePath = Annotated[str, BeforeValidator(_code), PlainSerializer(_relocate_code)]
"""``<file>.py:<name>``, the file relative to the study file."""

Names = Annotated[
    tuple[Name, ...],
    Field(min_length=1),
    BeforeValidator(_as_list, json_schema_input_type=str | tuple[Name, ...]),
]
Paths = Annotated[
    tuple[Pattern, ...],
    Field(min_length=1),
    BeforeValidator(_as_list, json_schema_input_type=str | tuple[Pattern, ...]),
]
