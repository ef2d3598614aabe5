"""The text of a study: YAML with the line of every key, and what --set changes."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from bo_sysid.errors import StudyError, nearest
from bo_sysid.yaml_text import Loader

KeyPath = tuple[str | int, ...]

_SHOWN = 60  # letters of an argument in a message
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_OTHER_BASE = re.compile(r"[-+]?0[0-7_]+|.*:.*")  # octal, or counted by 60
_SHORT: Mapping[tuple[str, ...], str] = {
    ("model",): "file",
    ("recordings", "columns", "*"): "from",
    ("recordings", "clocks", "*"): "from",
    ("compare", "arms", "*"): "acquisition",
}
"""Where a text may stand for a mapping, and which of its keys the text is."""


@dataclass(frozen=True)
class Source:
    """A study before validation, and where each of its keys comes from.

    Attributes:
        name: file name for messages.
        data: the mapping that was written, overrides included.
        node: YAML node of the whole file; None where the study is no file.
        overridden: key path of each override, with the text of its key.
    """

    name: str
    data: dict[str, Any]
    node: yaml.Node | None = None
    overridden: Mapping[KeyPath, str] = field(default_factory=dict)

    def where(self, path: KeyPath) -> str:
        """Return the place that sets `path`, such as ``"line 12"`` or ``"--set search.budget"``."""
        for n in range(len(path), 0, -1):
            if path[:n] in self.overridden:
                return f"--set {self.overridden[path[:n]]}"
        inside = [f"--set {k}" for p, k in self.overridden.items() if p[: len(path)] == path]
        written = [f"line {_line(self.node, path)}"] if self.node else []
        return " with ".join([*written, *inside])

    def error(self, path: KeyPath, message: str) -> StudyError:
        """Return an error that names file, line and key."""
        place = ", ".join(filter(None, [self.name, self.where(path)]))
        return StudyError(f"{place}: {dotted(path)}: {message}")


def dotted(path: KeyPath) -> str:
    """Return a key path as it is written for --set, such as ``parameters.0.low``."""
    return ".".join(str(p) for p in path)


def read(path: Path, overrides: Mapping[str, Any]) -> Source:
    """Read a study file.

    Raises:
        StudyError: the file is missing, is no YAML, or repeats a key.
    """
    text = _text(path)
    try:
        node = yaml.compose(text, Loader=Loader)
        if node is not None:
            _check_nodes(str(path), node, set(), ())
        data = Loader(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise StudyError(f"{path}{line}: not YAML: {error.problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise StudyError(f"{path}: not YAML: {error}") from None
    except RecursionError:
        raise StudyError(f"{path}: nested too deeply for a study") from None
    if not isinstance(data, dict):
        raise StudyError(
            f"{path}: a study is a mapping with the keys model and recordings, not "
            f"{'empty' if data is None else type(data).__name__}"
        )
    return override(Source(str(path), data, node), overrides)


def matching(folder: Path, pattern: str) -> list[Path]:
    """Return the files that a pattern matches, relative to `folder` unless it is absolute.

    Raises:
        StudyError: it is no pattern.
    """
    anchor, parts = Path(pattern).anchor, Path(pattern).parts
    root = Path(anchor) if anchor else folder
    if parts in ((), (anchor,)):  # the folder itself
        return [root]
    if (named := folder / pattern).exists():  # such as "run [1].csv", which is no pattern
        return [named]
    if any("**" in part and part != "**" for part in parts):
        raise StudyError(
            f"{pattern!r} is no pattern: ** stands for folders and must be alone between slashes, "
            "as in 'data/**/*.csv'"
        )
    return sorted(root.glob(str(Path(pattern).relative_to(anchor))))


def override(source: Source, overrides: Mapping[str, Any]) -> Source:
    """Return `source` with values replaced.

    Args:
        source: the study as written.
        overrides: value by dotted key (``search.budget``, ``parameters.0.low``); where a part of
            the key names a key with dots in it (``recordings.noise.qpos.elbow``), that is meant.
    """
    data: Any = source.data
    overridden = dict(source.overridden)
    for key, value in overrides.items():
        path = _resolve(data, key)
        data = _replaced(data, path, value, key)
        overridden[path] = key
    return Source(source.name, data, source.node, overridden)


def parse_override(text: str) -> tuple[str, Any]:
    """Split ``key=value``; the value is read as YAML.

    Raises:
        StudyError: there is no ``=``, or the value is not YAML or not as `read` takes it.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise StudyError(f"--set {text}: must be key=value, as in --set search.budget=20")
    try:
        node = yaml.compose(value, Loader=Loader)
        if node is not None:
            _check_nodes(f"--set {text[:_SHOWN]}", node, set(), ())
        return key.strip(), Loader(value).get_single_data()
    except (yaml.YAMLError, ValueError, RecursionError):
        raise StudyError(f"--set {text[:_SHOWN]}: the value is not YAML") from None


def _text(path: Path) -> str:
    if path.is_dir():
        raise StudyError(f"{path}: is a folder, not a study file")
    if not path.exists():
        folder = path.parent
        found = [p.name for p in folder.glob("*.y*ml")] if folder.is_dir() else []
        hint = nearest(path.name, found) if found else f"no study in {folder}"
        raise StudyError(f"{path}: no such file; {hint}")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise StudyError(f"{path}: not a text file in UTF-8; a study is YAML") from None


def _check_nodes(name: str, node: yaml.Node, done: set[int], inside: tuple[int, ...]) -> None:
    """Refuse keys that are written twice, nodes that contain themselves and numbers of other bases.

    YAML 1.1 reads 017 as 15, and 1:30 as 90.
    """
    if id(node) in inside:
        raise StudyError(f"{name}, line {node.start_mark.line + 1}: an alias contains itself")
    if id(node) in done:
        return
    done.add(id(node))
    inside = (*inside, id(node))
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_nodes(name, item, done, inside)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            line = key.start_mark.line + 1
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in lines:
                    raise StudyError(
                        f"{name}, line {line}: key {key.value!r} is written twice, first in line "
                        f"{lines[key.value]}"
                    )
                lines[key.value] = line
            _check_nodes(name, value, done, inside)
    elif node.tag in _NUMBERS and _OTHER_BASE.fullmatch(node.value):
        raise StudyError(
            f"{name}, line {node.start_mark.line + 1}: YAML reads {node.value} as "
            f"{yaml.safe_load(node.value)}; write the number without leading zeros and colons, or "
            "in quotes if it is a text"
        )


def _line(node: yaml.Node, path: KeyPath) -> int:
    """Return the line of the deepest part of `path` that is written."""
    line = int(node.start_mark.line)
    for part in path:
        if isinstance(node, yaml.MappingNode):
            found = [(k, v) for k, v in node.value if str(getattr(k, "value", "")) == str(part)]
            if not found:
                break
            line, node = int(found[0][0].start_mark.line), found[0][1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            if part >= len(node.value):
                break
            node = node.value[part]
            line = int(node.start_mark.line)
        else:
            break
    return line + 1


def _is_number(part: str) -> bool:
    return part.isascii() and part.isdecimal()


def _resolve(data: Any, key: str) -> KeyPath:
    parts = key.split(".")
    path: list[str | int] = []
    while parts:
        if isinstance(data, Sequence) and not isinstance(data, str) and _is_number(parts[0]):
            item = int(parts.pop(0))
            path.append(item)
            data = data[item] if item < len(data) else None
            continue
        known = data if isinstance(data, Mapping) else {}
        size = next((n for n in range(len(parts), 0, -1) if ".".join(parts[:n]) in known), 1)
        name, parts = ".".join(parts[:size]), parts[size:]
        path.append(name)
        data = known.get(name)
    return tuple(path)


def _replaced(data: Any, path: KeyPath, value: Any, key: str, at: KeyPath = ()) -> Any:
    """Return a copy of `data`, which stands `at` a key, with `value` at `path` in it.

    Mappings on the way are made.
    """
    if not path:
        return value
    first, rest = path[0], path[1:]
    inside = (*at, first)
    if isinstance(first, int) and isinstance(data, Sequence) and not isinstance(data, str):
        if first >= len(data):
            raise StudyError(f"--set {key}: there is no entry {first}; there are {len(data)}")
        changed = _replaced(data[first], rest, value, key, inside)
        return [changed if i == first else d for i, d in enumerate(data)]
    old = _opened(data, at)
    return {**old, first: _replaced(old.get(first), rest, value, key, inside)}


def _opened(data: Any, at: KeyPath) -> dict[Any, Any]:
    """Return a mapping, or that for which a text stands; empty where there is none."""
    if isinstance(data, Mapping):
        return dict(data)
    meant = [
        name
        for short, name in _SHORT.items()
        if len(short) == len(at) and all(s in ("*", a) for s, a in zip(short, at, strict=True))
    ]
    return {meant[0]: data} if isinstance(data, str) and meant else {}
