"""The examples of the README are files that work."""

import re
from pathlib import Path

import pytest

from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"```\w*\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)


@pytest.mark.parametrize(
    ("words", "name"), [("name: crane", "crane.yaml"), ("class Park", "crane_task.py")]
)
def test_the_example_of_learning_is_what_lies_in_studies(words: str, name: str) -> None:
    (shown,) = [block for block in BLOCKS if words in block]
    assert (ROOT / "studies" / "crane" / name).read_text(encoding="utf-8") == shown


def test_its_parameters_are_in_its_model() -> None:
    study = Study.load(ROOT / "studies" / "crane" / "crane.yaml", trust_code=True)
    parameters = study.parameter_set(load_model(study))
    assert [p.name for p in parameters] == ["load", "rail"]
