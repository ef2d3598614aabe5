"""A conformance suite over every dataset (where its files are), and how files are found."""

import functools
import hashlib
import http.server
import itertools
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.recording import DATASETS, Dataset, Recording, Sampling, load_dataset
from bo_sysid.recording.datasets.source import SourceFile, locate

DATA = os.environ.get("BO_SYSID_DATA", "")
needs_data = pytest.mark.skipif(
    not DATA or not Path(DATA).is_dir(), reason="$BO_SYSID_DATA is not a folder with recordings"
)


@functools.cache
def loaded(name):
    return load_dataset(name)


@needs_data
@pytest.mark.parametrize("name", DATASETS)
def test_every_dataset_is_named_split_cited_and_sampled_in_seconds(name):
    data = loaded(name)
    assert data.name == name
    assert data.citation
    assert data.notes
    names = [r.name for r in data.train + data.holdout]
    assert len(names) == len(set(names))
    layout = {n: (c.unit, c.hold) for n, c in data.train[0].channels.items()}
    for recording in data.train + data.holdout:
        mine = {n: (c.unit, c.hold) for n, c in recording.channels.items() if n != "aux.pulses"}
        assert mine == layout
        assert recording.notes
        median = [Sampling.of(c.time).median_dt for c in recording.channels.values()]
        assert 5e-4 <= min(median) <= max(median) <= 2e-2


@needs_data
@pytest.mark.parametrize("name", [n for n in DATASETS if n not in ("emps", "contactnets_cube")])
def test_recorded_rates_are_those_of_the_recorded_positions(name):
    """Order, sign and unit of every joint: the rates integrate to the angles."""
    for recording in loaded(name).train:
        for joint, rate in recording.of_kind("qvel").items():
            position = recording.channels[f"qpos.{joint}"]
            if np.ptp(position.values) < 0.1:
                continue  # the joint sticks
            steps = np.diff(rate.time)
            travel = np.concatenate([[0.0], np.cumsum(rate.values[1:] * steps)])
            slope = np.polyfit(position.values, travel, 1)[0]
            assert slope == pytest.approx(1.0, abs=0.25), f"{recording.name}: {joint}"


@needs_data
def test_emps_is_what_its_authors_describe():
    data = loaded("emps")
    (train,), (pulses,) = data.train, data.holdout
    assert [r.channels["qpos.x"].values.size for r in (train, pulses)] == [24841, 24841]
    assert Sampling.of(train.channels["qpos.x"].time).median_dt == pytest.approx(1e-3, rel=1e-4)
    # the controller's law, from the authors: v = kp·kv·(qg − q) − kv·dq
    q, goal = train.channels["qpos.x"].values, train.channels["goal.vir"].values
    smooth = np.convolve(q, [0.5, 0.5])[: q.size]
    rate = np.diff(smooth, prepend=smooth[0]) / 1e-3
    law = 160.18 * 243.45 * (goal - q) - 243.45 * rate
    error = (train.channels["ctrl.vir"].values - law)[100:]
    assert np.median(np.abs(error)) < 0.05
    assert pulses.channels["aux.pulses"].unit == "N"


@needs_data
def test_xl330_duty_follows_the_servos_law():
    for run in loaded("bam_xl330").train:
        kp = run.channels["aux.kp"].values[0]
        q, goal = run.channels["qpos.pendulum"].values, run.channels["goal.motor"].values
        on = run.channels["aux.torque_enable"].values == 1
        duty = np.clip(kp * (goal - q) * 4096 / (2 * np.pi * 256 * 885), -1, 1)
        measured = run.channels["aux.duty"].values
        assert np.median(np.abs(measured - duty)[on]) < 0.01
        assert not measured[~on].any()
        np.testing.assert_array_equal(
            run.channels["ctrl.motor"].values, measured * run.channels["aux.voltage"].values
        )
    gains = {r.channels["aux.kp"].values[0] for r in loaded("bam_xl330").holdout}
    assert gains == {200.0}


@needs_data
def test_double_pendulum_joints_are_not_exchanged():
    runs = {r.name: r for r in loaded("dfki_double_pendulum").train}
    stuck = runs["C.1_20230629-143906"].channels  # only the shoulder was driven; the elbow sticks
    assert not stuck["ctrl.elbow"].values.any()
    assert np.ptp(stuck["qpos.elbow"].values) < 0.01 < 0.5 < np.ptp(stuck["qpos.shoulder"].values)
    for run in runs.values():
        for joint, command in run.of_kind("ctrl").items():
            if command.values.any():
                measured = run.channels[f"aux.torque_{joint}"].values
                assert np.corrcoef(command.values, measured)[0, 1] > 0.7


@needs_data
def test_cube_falls_with_gravity_and_turns_in_the_body_frame():
    mujoco = pytest.importorskip("mujoco")
    toss = loaded("contactnets_cube").train[0]
    qpos = np.stack([toss.channels[f"qpos.cube.{i}"].values for i in range(7)], axis=1)
    qvel = np.stack([toss.channels[f"qvel.cube.{i}"].values for i in range(6)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:], axis=1), 1.0, atol=1e-9)
    # MuJoCo's own difference of two free-joint positions is the velocity of the second row
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    difference = np.empty((len(qpos) - 1, 6))
    for row, (a, b) in enumerate(itertools.pairwise(qpos)):
        mujoco.mj_differentiatePos(model, difference[row], 1 / 148, a, b)
    flying = slice(0, 30)  # before the first impact; it turns fast enough to tell the frames apart
    error = np.median(np.abs(difference - qvel[1:])[flying], axis=0)
    assert np.all(error < [0.02] * 3 + [0.05] * 3)
    assert np.linalg.norm(qvel[flying, 3:], axis=1).min() > 3.0
    heights = qpos[:, 2]
    assert 0.03 < heights.min() < heights[-1] < 0.06  # half a side above the table at rest


@needs_data
def test_cube_free_flight_accelerates_as_checked():
    accelerations = []
    for toss in loaded("contactnets_cube").train:
        z = toss.channels["qpos.cube.2"].values
        flying = z[1:-1] > 0.12
        accelerations.append(np.diff(z, 2)[flying] * 148**2)
    assert np.median(np.concatenate(accelerations)) == pytest.approx(-9.62, abs=0.15)


@needs_data
def test_qube_states_outnumber_inputs_by_one():
    run = loaded("quanser_qube").train[0]
    assert run.channels["qpos.arm"].time.size == run.channels["ctrl.motor"].time.size + 1


def test_an_unknown_dataset_names_the_nearest():
    with pytest.raises(RecordingError, match="unknown dataset 'emsp'; did you mean 'emps'"):
        load_dataset("emsp")


def test_the_held_out_part_is_read_when_it_is_asked_for_and_once():
    opened = []

    def read(part):
        opened.append(part)
        return (Recording.from_arrays([0.0, 1.0], qpos={"a": [0.0, 1.0]}),)

    data = Dataset("d", lambda: read("train"), lambda: read("holdout"), "Someone, 2020.")
    assert data.train is data.train
    assert opened == ["train"]
    assert data.holdout is data.holdout
    assert opened == ["train", "holdout"]


@pytest.mark.parametrize("name", ["quanser_qube", "contactnets_cube"])
def test_sources_that_must_be_converted_say_how(name, monkeypatch, tmp_path):
    monkeypatch.setenv("BO_SYSID_DATA", str(tmp_path))
    with pytest.raises(RecordingError, match=r"not under \$BO_SYSID_DATA.*numpy.savez"):
        _ = load_dataset(name).train
    monkeypatch.delenv("BO_SYSID_DATA")
    with pytest.raises(RecordingError, match=r"\$BO_SYSID_DATA is not set.*numpy.savez"):
        _ = load_dataset(name).holdout


@pytest.fixture
def server(tmp_path):
    """Serve the folder `tmp_path/public` and count what is fetched."""
    public = tmp_path / "public"
    public.mkdir()
    fetched = []

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments):
            super().__init__(*arguments, directory=str(public))

        def log_message(self, *arguments):
            fetched.append(self.path)

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield public, f"http://127.0.0.1:{running.server_port}", fetched
        running.shutdown()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("BO_SYSID_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("BO_SYSID_DATA", raising=False)
    return tmp_path / "cache"


def test_a_file_is_downloaded_once_and_checked(server, cache):
    public, url, fetched = server
    (public / "log.csv").write_text("time,qpos.a\n")
    digest = hashlib.sha256(b"time,qpos.a\n").hexdigest()
    file = SourceFile("runs/log.csv", f"{url}/log.csv", digest)
    for _ in range(2):
        path = locate("arm", file, "Ask.")
        assert path == cache / "arm" / "runs" / "log.csv"
        assert path.read_text() == "time,qpos.a\n"
    assert fetched == ["/log.csv"]


def test_a_download_with_another_checksum_is_refused_and_leaves_nothing(server, cache):
    public, url, _ = server
    (public / "log.csv").write_text("tampered\n")
    file = SourceFile("log.csv", f"{url}/log.csv", "0" * 64)
    with pytest.raises(RecordingError, match=r"log.csv could not be downloaded.*hash.*Ask."):
        locate("arm", file, "Ask.")
    assert not [p for p in cache.rglob("*") if p.is_file()]


def test_without_a_network_the_error_says_where_to_put_the_file(server, cache):
    _, url, _ = server
    file = SourceFile("log.csv", f"{url}/absent.csv", "0" * 64)
    with pytest.raises(RecordingError, match=r"could not be downloaded.*Ask."):
        locate("arm", file, "Ask.")


@pytest.mark.parametrize("copy", ["log.csv", "log.csv.gz"])
def test_local_files_and_gzipped_copies_come_first(copy, cache, monkeypatch, tmp_path):
    folder = tmp_path / "data" / "arm"
    folder.mkdir(parents=True)
    (folder / copy).touch()
    monkeypatch.setenv("BO_SYSID_DATA", str(tmp_path / "data"))
    assert locate("arm", SourceFile("log.csv"), "Ask.") == folder / copy


def test_a_gzipped_copy_that_no_reader_takes_is_not_found(monkeypatch, tmp_path):
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "log.json.gz").touch()
    monkeypatch.setenv("BO_SYSID_DATA", str(tmp_path))
    with pytest.raises(RecordingError, match=r"log.json: it is not under \$BO_SYSID_DATA"):
        locate("arm", SourceFile("log.json"), "Ask.")
