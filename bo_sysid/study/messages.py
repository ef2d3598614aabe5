"""One clear message for everything that is wrong with a study."""

from collections.abc import Mapping
from datetime import date
from typing import Any, get_args, get_origin

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from bo_sysid.errors import StudyError, nearest
from bo_sysid.study.base import Section
from bo_sysid.study.source import KeyPath, Source, dotted

_COLUMNS = ("recordings", "columns")
_RULES = {
    "missing": "this key is required",
    "model_type": "must be a mapping (key: value)",
    "dict_type": "must be a mapping (key: value)",
    "mapping_type": "must be a mapping (key: value)",
    "tuple_type": "must be a list",
    "string_type": "must be text (numbers, dates and yes/no need quotes)",
    "string_too_short": "must not be empty",
    "too_short": "must not be empty",
}


def study_error(error: ValidationError, source: Source, root: type[Section]) -> StudyError:
    """Translate pydantic's error: every problem with its line, key, rule and nearest choice."""
    rules: dict[KeyPath, list[str]] = {}
    for detail in error.errors(include_url=False):
        path = _as_written(source.data, detail)
        rules.setdefault(path, []).append(_rule(detail, path, root))
    problems = [
        _problem(source, path, rules[path])
        for path in rules
        # a union also complains that the whole is not its other member
        if not any(len(other) > len(path) and other[: len(path)] == path for other in rules)
    ]
    if len(problems) == 1:
        return StudyError(f"{source.name}{', ' if source.node else ': '}{problems[0]}")
    listed = "".join(f"\n  {p}" for p in problems)
    return StudyError(f"{source.name}: {len(problems)} problems{listed}")


def keys_at(annotation: Any, path: KeyPath) -> set[str]:
    """Return the keys that a study allows inside `path`, seen from a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        fields = {f.alias or n: f for n, f in annotation.model_fields.items()}
        if not path:
            return set(fields)
        field = fields.get(str(path[0]))
        return keys_at(field.annotation, path[1:]) if field else set()
    # the value of a mapping and the item of a list are one step further in; a union is not
    inner = path[1:] if get_origin(annotation) in (tuple, Mapping) else path
    return set().union(*[keys_at(a, inner) for a in get_args(annotation)])


def _elsewhere(root: type[Section], path: KeyPath) -> str:
    """Return in words which sections have a key of that name, nothing where none has."""
    sections = [s for s in sorted(keys_at(root, ())) if path[-1] in keys_at(root, (s,))]
    return f" ({path[-1]!r} is a key of {' or '.join(sections)})" if sections else ""


def _problem(source: Source, path: KeyPath, rules: list[str]) -> str:
    unique = list(dict.fromkeys(rules))
    rule = unique[0]
    if len(unique) > 1:  # what each member of a union wants
        wanted = [r.removeprefix("must be ").split(", not ")[0] for r in unique]
        rule = f"must be {' or '.join(wanted)}"
    place = [source.where(path), dotted(path)]
    return ": ".join([*filter(None, place), rule])


def _as_written(data: Any, detail: ErrorDetails) -> KeyPath:
    """Return where pydantic's error is in the data, without its marks for members of a union."""
    path: list[str | int] = []
    for part in detail["loc"]:
        if _holds(data, part):
            data = data[part]
        elif not (detail["type"] == "missing" and part == detail["loc"][-1]):
            continue
        path.append(part)
    return tuple(path)


def _holds(data: Any, part: str | int) -> bool:
    if isinstance(data, Mapping):
        return part in data
    return isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)


def _is_a_nested_channel(path: KeyPath) -> bool:
    """Return whether a channel of a recording, as qpos.elbow, is written as two keys."""
    if path[:2] != _COLUMNS or len(path) != len(_COLUMNS) + 2:
        return False
    from bo_sysid.recording import KINDS  # loads numpy, which other mistakes answer without

    return path[-2] in KINDS


def _rule(detail: ErrorDetails, path: KeyPath, root: type[Section]) -> str:
    kind, value = detail["type"], detail["input"]
    if kind == "extra_forbidden":
        if _is_a_nested_channel(path):
            return f"unknown key; a channel is one key: {path[-2]}.{path[-1]}"
        valid = nearest(str(path[-1]), keys_at(root, path[:-1]))
        return f"unknown key; {valid}{_elsewhere(root, path)}"
    if kind == "value_error":
        return str(detail["ctx"]["error"])
    rule = _RULES.get(kind) or detail["msg"].replace("Input should be", "must be")
    if kind == "missing" or not isinstance(value, str | int | float | bool | date):
        return rule
    shown = str(value) if isinstance(value, date) else repr(value)
    return f"{rule.split(', unable to')[0]}, not {shown}"
