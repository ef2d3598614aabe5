"""`bo-sysid effects`: the catalogue as a table and as JSON."""

import json
from pathlib import Path

import pytest

from bo_sysid.cli import main
from bo_sysid.effects import CATALOGUE

MINE = Path(__file__).parent.parent / "studies" / "effects" / "my_effect.py"


def test_a_row_for_each_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split("  ")[0] == "id"
    assert "what gives it away" in head
    assert {row.split()[0] for row in rows} == set(CATALOGUE)
    friction = next(r for r in rows if r.startswith("dry_friction"))
    for words in ("joint", "N m", "frictionloss", "a step of force where the velocity changes"):
        assert words in friction


def test_json_says_all_and_knows_effects_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "--json", "--file", str(MINE)]) == 0
    found = {e["id"]: e for e in json.loads(capsys.readouterr().out)}
    assert set(found) == {*CATALOGUE, "worn_spot"}
    assert found["worn_spot"]["source"] == str(MINE.resolve())
    assert found["cogging"]["source"] == ""
    assert found["cogging"]["components"] == "sine [N m], cosine [N m], periods [1/rad]"
    for effect in found.values():
        assert effect["site"] in ("joint", "body", "world", "geom", "actuator", "channel")
        assert all(effect[k] for k in ("unit", "evidence", "separation", "sentence"))


def test_a_file_that_is_no_effect_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "none.py").write_text("x = 1")
    assert main(["effects", "--file", str(tmp_path / "none.py")]) == 2
    assert "none.py: registers no effect" in capsys.readouterr().err
