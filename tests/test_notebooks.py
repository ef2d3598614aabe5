"""Every notebook runs from top to bottom, at a smaller budget."""

import os
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext", reason="the group notebooks is not installed")
nbclient = pytest.importorskip("nbclient", reason="the group notebooks is not installed")

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.py"))
SMALLER = {
    "concealed_proof": [("CASES = 3", "CASES = 2"), ('"proof-conceal"', '"none"')],
    "inner_loop": [("BUDGET = 30", "BUDGET = 20"), ("STEPS = 31", "STEPS = 11")],
    "real_machine": [
        ('EFFECTS = "all"', 'EFFECTS = ["constant_force", "dry_friction", "viscous_damping"]')
    ],
    "selection": [("SEEDS = 6", "SEEDS = 2"), ('"selection-inner"', '"none"')],
}


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the kernel's own
def test_notebook_runs(path: Path) -> None:
    if path.stem == "real_machine" and not os.environ.get("BO_SYSID_DATA"):
        pytest.skip("no recordings of EMPS: $BO_SYSID_DATA is not set")
    text = path.read_text()
    for whole, small in SMALLER[path.stem]:
        assert text.count(whole) == 1, f"{path.name} no longer says {whole!r}: adapt SMALLER"
        text = text.replace(whole, small)
    notebook = jupytext.reads(text, fmt="py:percent")
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()


def test_every_notebook_has_a_smaller_budget() -> None:
    assert {p.stem for p in NOTEBOOKS} == set(SMALLER)
