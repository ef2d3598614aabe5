"""Progress: lines now and then where there is no terminal, a bar where there is one."""

import io
import time

import pytest

from bo_sysid.cli.progress import Lines, shown
from bo_sysid.execution import Progress


class Clock:
    """A clock that the test moves."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_lines_come_now_and_then_with_the_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    report = Lines("identify", every=5.0, clock=clock)
    for step in range(1, 61):
        clock.now += 2.0
        report(Progress(step, 60, f"lowest deviation {1 / step:.2g}"))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "identify 3/60, 1:54 left: lowest deviation 0.33"
    assert lines[1].startswith("identify 6/60, 1:48 left")
    assert lines[-1] == "identify 60/60: lowest deviation 0.017"
    assert len(lines) == 20


def test_a_line_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    """The last evaluation is told again once its entropy is known."""
    lines = Lines("search", every=0.0, clock=lambda: 0.0)
    for entropy in ("", "", ", entropy 1.2"):
        lines(Progress(9, 9, f"deviation 0.1{entropy}"))
    assert capsys.readouterr().err.splitlines() == [
        "search 9/9: deviation 0.1",
        "search 9/9: deviation 0.1, entropy 1.2",
    ]


@pytest.mark.parametrize(("step", "of", "left"), [(10, 4000, "11:05:00"), (10, 20, "1:40")])
def test_time_left_is_right_after_a_resume(
    capsys: pytest.CaptureFixture[str], step: int, of: int, left: str
) -> None:
    clock = Clock()
    report = Lines("x", every=5.0, clock=clock)
    for k in range(1, step + 1):  # an evaluation takes 10 s; 50 were there before
        clock.now += 10.0
        report(Progress(50 + k, 50 + of, ""))
    assert capsys.readouterr().err.splitlines()[-1] == f"x {50 + step}/{50 + of}, {left} left"


def test_time_left_is_that_of_the_count_that_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    """Behind the answers of a proof come its oracle's, counted from one again."""
    clock = Clock()
    report = Lines("reveal", every=5.0, clock=clock)
    for step in range(1, 5):
        clock.now += 60.0
        report(Progress(step, 4, "case"))
    for step in range(1, 3):
        clock.now += 10.0
        report(Progress(step, 4, "oracle"))
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "reveal 1/4, 0:30 left: oracle", "reveal 2/4, 0:20 left: oracle",
    ]  # fmt: skip


def test_units_of_unlike_length_tell_time_left_by_their_share(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The stages of a diagnosis: short windows, long ones, final fits, forecasts."""
    clock = Clock()
    report = Lines("diagnose", every=5.0, clock=clock)
    clock.now += 20.0
    report(Progress(1, 4, "windows of 75 instants", share=0.4))
    assert capsys.readouterr().err == "diagnose 1/4, about 0:30 left: windows of 75 instants\n"


@pytest.mark.parametrize("share", [None, 0.001])
def test_a_bar_tells_time_left_by_a_share_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch, share: float | None
) -> None:
    stream = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", stream)
    with shown("diagnose") as report:
        time.sleep(0.05)  # a thousandth of 50 s
        report(Progress(1, 4, "windows", share=share))
        report(Progress(1, 4, "12 sets", passing=True))
    assert ("about" in stream.getvalue().split("1/4")[-1]) == (share is not None)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", stream)
    with shown("identify") as report:
        report(Progress(30, 60, "lowest [deviation] 0.5"))
    assert "30/60" in stream.getvalue()
    assert "lowest [deviation] 0.5" in stream.getvalue()


def test_no_terminal_gets_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with shown("record") as report:
        report(Progress(1, 2, "train-0"))
        report(Progress(2, 2, "train-1"))
    assert capsys.readouterr().err == "record 2/2: train-1\n"


def test_what_is_said_before_the_first_step_is_said_at_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = Clock()
    report = Lines("diagnose", every=5.0, clock=clock)
    report(Progress(0, 2, "the elbow leaves its range"))
    clock.now += 10.0
    report(Progress(1, 2, "half"))
    assert capsys.readouterr().err.splitlines() == [
        "diagnose: the elbow leaves its range", "diagnose 1/2, 0:10 left: half",
    ]  # fmt: skip


def test_a_long_step_says_that_it_is_still_at_it(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    lines = Lines("diagnose", clock=lambda: now[0])
    lines(Progress(1, 6, "windows"))
    now[0] = 59.0
    lines.still()
    now[0] = 125.0
    lines.still()
    assert capsys.readouterr().err.splitlines()[-1:] == ["diagnose: at this step for 2:05"]
    lines(Progress(1, 6, "34 sets fitted", passing=True))
    assert capsys.readouterr().err == ""  # no line of its own
    now[0] = 190.0
    lines.still()
    assert capsys.readouterr().err == "diagnose: at this step for 3:10: 34 sets fitted\n"
