"""YAML as studies have it: what is written is read again as what it was."""

import re
from collections.abc import Mapping
from typing import Any

import yaml

_FLOAT = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$")  # of YAML 1.2's core schema


class Loader(yaml.SafeLoader):
    """Reads YAML, numbers such as 1e5 among them, which YAML 1.1 takes for text."""


class _Dumper(yaml.SafeDumper):
    """Writes text that `Loader` would take for a number, such as the name 2e3, in quotes."""


for _reads in (Loader, _Dumper):
    _reads.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def dumped(data: Mapping[str, Any], *, flow: bool = False) -> str:
    """Return a mapping as YAML, its keys in their order.

    Args:
        data: mappings, sequences, text, numbers and truth values.
        flow: on one line.
    """
    return yaml.dump(
        dict(data), Dumper=_Dumper, sort_keys=False, allow_unicode=True,
        default_flow_style=flow, width=1000 if flow else 80,
    )  # fmt: skip
