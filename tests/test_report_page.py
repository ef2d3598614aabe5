"""The page of a run: what it shows, that text stays text, and what it says of a damaged run."""

import http.client
import json
import re
import shutil
import threading
import urllib.error
import urllib.request
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from chromium import ask, needs_chromium

from bo_sysid.errors import RunError
from bo_sysid.report import interactive, interactive_search
from bo_sysid.report.learning import learning_summary
from bo_sysid.report.marked import site_labels
from bo_sysid.report.page import page, write_page
from bo_sysid.report.parts import Table
from bo_sysid.report.serve import make_server, version
from bo_sysid.runs import Run

NASTY = "<script>alert(1)</script>"
MODEL = f"""
<mujoco>
  <worldbody>
    <body name="rod">
      <joint name="{NASTY.replace("<", "&lt;")}" axis="0 1 0"/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/>
    </body>
  </worldbody>
</mujoco>
"""
SECTIONS = ["robot", "proof", "forces", "explanations", "data", "again"]


def finding(joint: str) -> dict[str, object]:
    return {
        "effect": "dry_friction", "kind": "joint", "site": joint, "value": 0.15, "unit": "N m",
        "interval": [0.14, 0.16], "before": 0.0, "after": 0.15, "details": {}, "group": None,
        "probability": 0.98, "equivalents": [], "sentence": f"The {joint} has dry friction.",
    }  # fmt: skip


def diagnosis(joint: str) -> dict[str, object]:
    forecast = {"unit": "sensor sigma", "horizon_s": 0.08, "nominal": 181.0, "refitted": 170.0,
                "repaired": 1.02, "learned_residual": None, "noise_floor": 1.01}  # fmt: skip
    return {
        "verdict": "missing-physics", "findings": [finding(joint)], "alternatives": [],
        "located": [],
        "holdout": {"forecast": forecast, "fit": {}, "free_run": {**forecast, "unit": "rad"}},
        "unexplained": {"share": 0.0, "kind": None, "site": None, "depends_on": []},
        "next_experiment": None, "model": "model_repaired.xml", "study": "study_repaired.yaml",
        "sha256": "",
    }  # fmt: skip


def test_the_robot_says_what_the_sentences_say_and_what_is_a_change() -> None:
    """A camera of 0.75 kg to which 0.149 kg were added was labelled "link mass 0.149 kg"."""
    camera = {
        "effect": "link_mass", "kind": "body", "site": "camera", "value": 0.1493, "unit": "kg",
        "interval": [0.1417, 0.1568], "before": 0.75, "after": 0.8993,
    }  # fmt: skip
    motor = {
        "effect": "actuator_gain", "kind": "actuator", "site": "tilt", "value": 0.0794,
        "unit": "relative", "interval": [0.0706, 0.0882], "before": 0.0, "after": 0.0794,
    }  # fmt: skip
    found = {"findings": [camera, motor, finding("elbow")], "unexplained": {"kind": None}}
    assert site_labels(found) == [
        ("body", "camera", "camera:\nlink mass +0.149 ± 0.008 kg"),
        ("actuator", "tilt", "tilt:\nactuator gain +7.9 ± 0.9 %"),
        ("joint", "elbow", "elbow:\ndry friction 0.150 ± 0.010 N m"),
    ]


def traces(joint: str, seconds: float, joints: int) -> pd.DataFrame:
    time = np.arange(0, seconds, 0.002)
    q = np.sin(3 * time)
    parts = [
        pd.DataFrame(
            {
                "recording": "holdout", "time": time, "window": (time // 2).astype(int),
                "channel": f"qpos.{joint}{k or ''}", "recorded": q, "nominal": 1.3 * q,
                "refitted": 1.2 * q, "repaired": q + 1e-3,
            }
        )
        for k in range(joints)
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def write_run(folder: Path, joint: str = NASTY, seconds: float = 4.0, joints: int = 2) -> Path:
    """Write what a diagnosis leaves."""
    speed = np.linspace(-3, 3, 40)
    pieces = pd.DataFrame(
        {
            "joint": joint, "time": np.arange(40.0), "position": np.sin(speed), "speed": speed,
            "unit": "N m", "nominal": -0.15 * np.sign(speed), "repaired": 0.001 * speed,
            "sigma": 0.01,
        }
    )  # fmt: skip
    sets = pd.DataFrame(
        {
            "set": [f"dry friction of {joint}", "nothing is missing"], "effects": [1, 0],
            "probability": [0.98, 0.0], "rms": [1.02, 120.0], "best": [True, False],
            "equivalent": False,
        }
    )  # fmt: skip
    with Run.open(folder, {"name": joint}, "diagnose", seed=0) as run:
        run.write_text("model_repaired.xml", MODEL)
        run.write_json("diagnosis.json", diagnosis(joint))
        run.write_json("pose.json", {f"qpos.{joint}": 0.7})
        run.write_json("summary.json", {"name": joint, "sentences": [joint], "notes": [joint]})
        run.write_frame("traces.parquet", traces(joint, seconds, joints))
        run.write_frame("forces.parquet", pieces)
        run.write_frame("sets.parquet", sets)
    return folder


class Outline(HTMLParser):
    """Collects the sections, the words outside scripts, and what the scripts hold."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.words, self.scripts = "", []
        self._script = False
        self.outside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "section":
            self.sections.append(given.get("id") or "")
        if tag == "script":
            self._script = True
            self.scripts.append("")
        linked = [v for k, v in given.items() if k in ("src", "srcset") and v]
        self.outside += [v for v in linked if not v.startswith("data:")]

    def handle_endtag(self, tag: str) -> None:
        self._script = self._script and tag != "script"

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[-1] += data
        else:
            self.words += data


def test_it_has_every_section_and_needs_no_network(tmp_path: Path) -> None:
    seen = Outline(page(write_run(tmp_path / "run")))
    assert seen.sections == SECTIONS
    assert not seen.outside
    assert "The model lacks physics." in seen.words
    assert "181" in seen.words
    assert "noise floor" in seen.words


def test_a_joint_called_script_shows_as_text(tmp_path: Path) -> None:
    seen = Outline(page(write_run(tmp_path / "run")))
    assert NASTY in seen.words
    assert not any(s.startswith("alert") for s in seen.scripts)
    assert not any("<script" in s for s in seen.scripts if s.lstrip().startswith("{"))


def test_figures_are_plotly_objects_of_what_was_stored() -> None:
    stored = traces("elbow", 4.0, 1)
    figure = interactive.held_out(stored, "qpos.elbow")
    drawn = {t.name.split(" (")[0]: t for t in figure.data if t.yaxis == "y"}
    assert set(drawn) == {
        "recorded", "nominal model", "refitted, no new physics", "repaired model"
    }  # fmt: skip
    shown = np.asarray(drawn["nominal model"].y, float)
    assert np.nanmax(shown) == pytest.approx(1.3, rel=1e-3)
    assert np.isnan(shown).sum() == stored["window"].nunique()  # a gap after each window
    error = next(t for t in figure.data if t.yaxis == "y2" and t.name.startswith("repaired"))
    assert np.nanmax(np.abs(np.asarray(error.y, float))) == pytest.approx(1e-3, rel=1e-2)


def test_each_held_out_recording_has_a_figure_of_its_own() -> None:
    one, two = (traces("elbow", seconds, 1).assign(recording=r) for r, seconds in HELD_OUT.items())
    drawn = interactive.all_held_out(pd.concat([one, two]), {}, 12)
    assert set(drawn) == {f"qpos.elbow, {r}" for r in HELD_OUT}
    for name, seconds in HELD_OUT.items():
        line = next(t for t in drawn[f"qpos.elbow, {name}"].data if t.name == "recorded")
        time = np.asarray(line.x, float)
        assert (np.diff(time) >= 0).all()
        assert time.max() == pytest.approx(seconds, abs=0.1)


HELD_OUT = {"morning": 4.0, "evening": 6.0}


def test_a_long_run_of_six_joints_stays_below_six_megabytes(tmp_path: Path) -> None:
    path = write_page(write_run(tmp_path / "run", "elbow", seconds=60.0, joints=6))
    assert path.stat().st_size < 6e6


def test_a_learning_run_says_first_what_the_policy_returns_on_the_plant(tmp_path: Path) -> None:
    study = {"version": 1, "name": "cheetah"}
    with Run.open(tmp_path / "learned", study, "learn", seed=1) as run:
        returned = {"mean": 354.0, "error": 18.4, "samples": 10}
        told = {"name": "cheetah", "waiting": "", "stopped": "No more is told.", "trajectories": 2,
                "seconds_recorded": 20.0, "chosen": {"gear": 0.97},
                "iterations": [{"trajectories": 2, "plant_return": returned,
                                "model_return": returned, "diagnosis": None}]}  # fmt: skip
        run.write_json("learning.json", told)
        columns = ["model_return", "episodes", "model_error", "plant_return", "plant_error"]
        rounds = pd.DataFrame({"trajectories": [1, 2], **{c: [1.0, 2.0] for c in columns}})
        run.write_frame("iterations.parquet", rounds)
        steps = pd.DataFrame({"learned": [1, 1, 2], "steps": [1, 2, 1], "batch_return": [1, 2, 3]})
        run.write_frame("training.parquet", steps)
    seen = Outline(page(tmp_path / "learned"))
    assert (
        "The policy returns 354 ± 42 on the plant, after 2 real trajectories (20 s)." in seen.words
    )
    assert "gear 0.97" in seen.words
    curves = interactive_search.training(steps).data
    assert [len(c.x) for c in curves] == [2, 1]


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (0, "On the study's recordings"),
        (1, "After 1 real trajectory"),
        (3, "After 3 real trajectories"),
    ],
)
def test_when_the_diagnosis_repaired_the_model_is_said_in_words(count: int, words: str) -> None:
    """It read "After 1 the diagnosis repaired the model."."""
    rounds = [{"trajectories": count, "diagnosis": {"verdict": "missing-physics"}}]
    told = {"waiting": "", "stopped": "Enough.", "trajectories": count, "seconds_recorded": 6.0,
            "chosen": {"load": 0.7}, "iterations": rounds}  # fmt: skip
    assert f"{words} the diagnosis repaired the model." in learning_summary(told)["sentences"]


def test_a_table_is_in_words() -> None:
    shown = Table.of(pd.DataFrame({"at_bound": [True, False], "low95": [0.12345678, np.nan]}))
    assert shown.columns == ("at bound", "low95")
    assert shown.rows == (("yes", "0.1235"), ("no", ""))


@pytest.mark.parametrize("files", [[], ["worn.py"]])
def test_a_study_that_names_code_is_run_again_with_the_users_trust(
    tmp_path: Path, files: list[str]
) -> None:
    (tmp_path / "rod.xml").write_text(MODEL)
    (tmp_path / "worn.py").write_text("raise SystemExit('a page runs no code')")
    data = {
        "version": 1, "name": "rod", "model": "../rod.xml", "recordings": {"train": ["../a.csv"]},
        "diagnosis": {"effect_files": [f"../{f}" for f in files]},
    }  # fmt: skip
    with Run.open(tmp_path / "run", data, "diagnose", seed=3):
        pass
    words = Outline(page(tmp_path / "run")).words
    assert "bo-sysid diagnose study.yaml --seed 3" in words
    assert ("--trust-code" in words) == bool(files)


def test_what_is_damaged_is_named_and_the_rest_is_shown(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    (run / "forces.parquet").write_text("no")
    (run / "traces.parquet").unlink()
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, "format": 99, "status": "interrupted"}))
    seen = Outline(page(run))
    assert seen.sections == ["problems", "robot", "proof", "explanations", "data", "again"]
    assert re.search(r"forces\.parquet: damaged", seen.words)
    assert "format 99" in seen.words
    assert "its status is interrupted" in seen.words
    (run / "diagnosis.json").write_text('{"verdict": 3}')
    seen = Outline(page(run))
    assert "not as this version writes it" in seen.words
    assert "again" in seen.sections
    (run / "diagnosis.json").write_text("no")
    assert "a file of the run is damaged" in Outline(page(run)).words


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"not a run folder \(it has no run\.json\)"):
        page(tmp_path)


def test_the_live_page_is_served_to_this_machine_and_follows_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", "elbow")
    (tmp_path / "secret.txt").write_text("no")
    with make_server(run) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.server_address[:2]
        assert host == "127.0.0.1"

        def get(name: str) -> str:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}", timeout=10) as answer:
                return answer.read().decode()

        assert "The model lacks physics." in get("")
        before = get("version")
        assert get("version") == before
        (run / "pose.json").write_text("{}")
        assert get("version") != before
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get("../secret.txt")
        (run / "next experiment.csv").write_text("controls")
        assert get("next%20experiment.csv") == "controls"
        hosts = {"127.0.0.1:9": 200, "localhost": 200, "other.example": 403, "[": 403}
        for host, status in hosts.items():
            asked = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            asked.request("GET", "/version", headers={"Host": host})
            assert asked.getresponse().status == status
            asked.close()
        server.shutdown()


def test_a_page_that_is_closed_is_no_error(tmp_path: Path, capsys) -> None:
    run = write_run(tmp_path / "run", "elbow")
    with make_server(run) as server:
        handler = object.__new__(server.RequestHandlerClass)
        handler.path, handler.headers = "/version", {"Host": "127.0.0.1"}
        handler.send_response = Mock(side_effect=BrokenPipeError)
        handler.send_error = Mock()
        handler.do_GET()
        handler.send_error.assert_not_called()


def test_where_p_and_p_boot_agree_both_are_seen() -> None:
    belief = pd.DataFrame({"mass": [1.0, 2.0, 3.0], "P": [0.0, 1.0, 0.0], "P_boot": [0.1, 0.9, 0]})
    boot, p = interactive_search.marginal(belief, "mass", "kg", 1.0).data
    assert (np.asarray(p.width) < np.asarray(boot.width)).all()  # P stands in front
    assert np.asarray(p.y).tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(("highest", "ticks"), [(0.1, "D2"), (1e4, None)])
def test_ticks_of_a_search_are_few_enough_to_be_read(highest: float, ticks: str | None) -> None:
    """Plotly writes each of 1 to 9 where an axis shows few decades, over each other."""
    figure = interactive_search.progress(pd.DataFrame({"deviation": [highest, 0.01]}))
    assert figure.layout.yaxis.dtick == ticks


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("width", [1200, 500])
def test_its_words_are_not_cut_off_or_on_each_other_and_nothing_offers_to_send_it(
    tmp_path: Path, width: int
) -> None:
    """Plotly's "Share chart" took the recordings to a server of its own."""
    path = write_page(write_run(tmp_path / "run", "elbow"))
    script = """
      const box = (plot, what) => {
        const all = [...document.querySelectorAll(`#${plot} ${what}`)];
        return all.map(e => e.getBoundingClientRect());
      };
      const turned = new WheelEvent("wheel", {deltaY: 9, bubbles: true, cancelable: true});
      document.querySelector("#plot-1-1 canvas").dispatchEvent(turned);
      return {
        buttons: [...document.querySelectorAll(".modebar-btn")].map(b => b.dataset.title),
        numbers: Math.max(...box("plot-2-1", ".x2tick text").map(r => r.bottom)),
        title: box("plot-2-1", ".x2title").map(r => [r.top, r.bottom])[0],
        legend: box("plot-2-1", ".legend")[0].top,
        words: Math.max(...box("plot-4-1", ".scatterlayer text").map(r => r.right)) - innerWidth,
        scrolls: !turned.defaultPrevented,
      };
    """
    answer, problems = ask(path, script, width)
    assert problems == []
    assert "Reset axes" in answer["buttons"]
    assert not any("share" in b.lower() or "cloud" in b.lower() for b in answer["buttons"])
    top, bottom = answer["title"]
    assert answer["numbers"] <= top
    assert bottom <= answer["legend"] + 1
    assert answer["words"] <= 0
    assert answer["scrolls"]  # over the robot, too


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("width", [1200, 500])
def test_it_is_drawn_without_errors_and_can_be_used(tmp_path: Path, width: int) -> None:
    path = write_page(write_run(tmp_path / "run"))
    script = """
      const plot = document.getElementById("plot-2-1");
      const first = plot.data[1].y.length;
      await Plotly.relayout(plot, {"xaxis.range": [1, 2]});
      const zoomed = [...plot.layout.xaxis.range];
      const select = document.querySelector("select[data-for='plot-2-1']");
      select.value = select.options[1].value;
      select.dispatchEvent(new Event("change"));
      await new Promise(r => setTimeout(r, 300));
      return {
        first, zoomed, shown: plot.dataset.shown, axis: plot.layout.yaxis.title.text,
        sections: [...document.querySelectorAll("section")].map(s => s.id),
        drawn: [...document.querySelectorAll(".plot")].every(p => p.querySelector("svg, canvas")),
        wide: document.documentElement.scrollWidth - innerWidth,
        ran: typeof window.ran,
      };
    """
    answer, problems = ask(path, script, width)
    assert problems == []
    assert answer["sections"] == SECTIONS
    assert answer["drawn"]
    assert answer["zoomed"] == [1, 2]
    assert answer["shown"] == f"qpos.{NASTY}1"
    assert "&lt;script&gt;" in answer["axis"]
    assert answer["wide"] <= 0  # nothing sticks out at this width
    shutil.rmtree(path.parent)


def test_a_page_that_is_served_follows_files_at_any_depth(tmp_path) -> None:
    (tmp_path / "records" / "small").mkdir(parents=True)
    (tmp_path / "run.json").write_text("{}")
    before = version(tmp_path)
    assert version(tmp_path) == before
    (tmp_path / "records" / "small" / "0.json").write_text("{}")
    assert version(tmp_path) != before
