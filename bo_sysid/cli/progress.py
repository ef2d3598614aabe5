"""Progress of long commands: a bar on a terminal, lines elsewhere; both on stderr."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from bo_sysid.execution import OnProgress, Progress

EVERY = 5.0
"""Least time between two lines, in s."""
STILL = 60.0
"""Time after which a long step says that it is still at it, in s."""


@contextlib.contextmanager
def shown(title: str) -> Iterator[OnProgress]:
    """Yield what a long computation, called `title`, reports its progress to."""
    if sys.stderr.isatty():
        with _bar(title) as report:
            yield report
    else:
        lines, over = Lines(title), threading.Event()
        beat = threading.Thread(target=_beating, args=(lines, over), daemon=True)
        beat.start()
        try:
            yield lines
        finally:
            over.set()
            beat.join()


def _beating(lines: "Lines", over: threading.Event) -> None:
    while not over.wait(STILL):
        lines.still()


class Lines:
    """Prints a line at most every few seconds, and the last one in any case.

    Args:
        title: what is being done.
        every: least time between two lines in [s].
        clock: returns the time in [s].
    """

    def __init__(
        self, title: str, every: float = EVERY, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._title, self._every, self._clock = title, every, clock
        self._began = self._last = self._told = clock()
        self._first: int | None = None
        self._step = 0
        self._at = self._said = ""

    def __call__(self, progress: Progress) -> None:
        """Print where it stands, unless a line was printed a moment ago.

        What is said before the first unit is done is printed at once, and is no measure of time.
        What is said in passing is printed where nothing else was for long.
        """
        if progress.passing:
            self._at = progress.message
            return
        self._at = ""
        if not progress.step:
            print(f"{self._title}: {progress.message}", file=sys.stderr, flush=True)
            return
        before, now = self._told, self._clock()
        self._told = now
        if self._first is None:
            self._first = progress.step - 1  # a resumed run does not begin at zero
        elif progress.step < self._step:  # another count begins
            self._first, self._began = progress.step - 1, before
        self._step = progress.step
        said = f"{progress.step}/{progress.of}: {progress.message}"
        if said == self._said:
            return
        if now - self._last < self._every and progress.step < progress.of:
            return
        self._last, self._said = now, said
        done, ahead = progress.step - self._first, progress.of - progress.step
        left = ""
        if progress.share and ahead:
            left = f", about {_duration(_ahead(now - self._began, progress.share))} left"
        elif done and ahead:
            left = f", {_duration((now - self._began) / done * ahead)} left"
        message = f": {progress.message}" if progress.message else ""
        print(
            f"{self._title} {progress.step}/{progress.of}{left}{message}",
            file=sys.stderr,
            flush=True,
        )

    def still(self) -> None:
        """Print how long nothing was said, where that is long."""
        since = self._clock() - self._told
        if since >= STILL:
            at = f": {self._at}" if self._at else ""
            print(
                f"{self._title}: at this step for {_duration(since)}{at}",
                file=sys.stderr,
                flush=True,
            )


@contextlib.contextmanager
def _bar(title: str) -> Iterator[OnProgress]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar
    from rich.text import Text

    class Left(TimeRemainingColumn):
        def render(self, task: Task) -> Text:
            ends = task.fields["ends"]
            if ends is None:
                return super().render(task)
            left = ends - time.monotonic()
            return Text(f"about {_duration(left)} left" if left > 0 else "")

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        Left(),
        TextColumn("{task.fields[message]}", markup=False),
    )
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task, began = bar.add_task(title, total=None, message="", ends=None), time.monotonic()

        def report(progress: Progress) -> None:
            bar.update(task, completed=progress.step, total=progress.of, message=progress.message)
            if progress.share and not progress.passing:
                now = time.monotonic()
                bar.update(task, ends=now + _ahead(now - began, progress.share))

        yield report


def _ahead(elapsed: float, share: float) -> float:
    """Return the time in [s] that is left of work of which a share took some."""
    return elapsed * (1.0 / share - 1.0)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
