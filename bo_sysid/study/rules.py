"""The rules of a study for columns and clocks of logs; what is wrong with one names its line."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from bo_sysid.errors import RecordingError
from bo_sysid.recording import ClockRule, ColumnRule
from bo_sysid.study.study import Study

_Rule = TypeVar("_Rule")


def column_rules(study: Study) -> dict[str, ColumnRule]:
    """Return how channels are read, by channel.

    Raises:
        StudyError: a name is no channel's, or a unit is unknown or says nothing of it.
    """
    return _rules(study, "columns", study.recordings.columns, ColumnRule.parse)


def clock_rules(study: Study) -> dict[str, ClockRule]:
    """Return where time stamps come from, by kind or channel.

    Raises:
        StudyError: a name is no kind of channel, or a unit is none of time.
    """
    return _rules(study, "clocks", study.recordings.clocks, ClockRule.parse)


def _rules(
    study: Study,
    key: str,
    sections: Mapping[str, Any],
    parse: Callable[[str, Mapping[str, Any]], _Rule],
) -> dict[str, _Rule]:
    rules = {}
    for name, section in sections.items():
        written = section.model_dump(by_alias=True, exclude_none=True)
        try:
            rules[name] = parse(name, written)
        except RecordingError as error:
            rule = str(error).removeprefix(f"{key}: {name}: ")
            raise study.error(("recordings", key, name), rule) from None
    return rules
