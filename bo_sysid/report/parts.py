"""What the page is made of: sections with text, figures, tables; and what a run folder holds."""

import json
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bo_sysid.errors import RunError
from bo_sysid.report.text import cell
from bo_sysid.runs import read_json

if TYPE_CHECKING:
    import plotly.graph_objects as go


@dataclass(frozen=True)
class Table:
    """A table, one row a list of cells."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]

    @classmethod
    def of(cls, frame: pd.DataFrame) -> "Table":
        """Return a DataFrame in words, numbers with four digits; what is missing is empty."""
        return cls(
            tuple(str(c).replace("_", " ") for c in frame.columns),
            tuple(tuple(_in_words(v) for v in row) for row in frame.to_numpy(object)),
            tuple(pd.api.types.is_numeric_dtype(frame[c]) for c in frame.columns),
        )


@dataclass(frozen=True)
class Plot:
    """Figures of which one is shown, chosen by its label.

    Attributes:
        words: what the figure shows, for those who do not see it.
        figures: by label.
        choice: what is chosen between: "channel", "joint".
    """

    words: str
    figures: dict[str, "go.Figure"]
    choice: str = ""

    @property
    def height(self) -> int:
        """Height in pixels."""
        return int(next(iter(self.figures.values())).layout.height)

    @property
    def content(self) -> str:
        """The figures as JSON that is safe inside a script element."""
        whole = {label: json.loads(f.to_json()) for label, f in self.figures.items()}
        return json.dumps(whole, separators=(",", ":")).replace("<", "\\u003c")


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        key: its anchor.
        title: its heading.
        text: paragraphs.
        plots: figures with their words.
        images: pictures as data URIs, with what they show.
        tables: with their captions.
        items: a list.
        code: shown as it is, by caption.
        links: files beside the page, with what they are.
    """

    key: str
    title: str
    text: Sequence[str] = ()
    plots: Sequence[Plot] = ()
    images: Sequence[tuple[str, str]] = ()
    tables: Sequence[tuple[str, Table]] = ()
    items: Sequence[str] = ()
    code: Sequence[tuple[str, str]] = ()
    links: Sequence[tuple[str, str]] = ()


@dataclass
class Found:
    """What a run folder holds, and what could not be read of it.

    Attributes:
        folder: the run folder.
        problems: what is missing or damaged, in words.
    """

    folder: Path
    problems: list[str] = field(default_factory=list)

    def has(self, name: str) -> bool:
        """Return whether a file is there."""
        return (self.folder / name).is_file()

    def picture(self, name: str) -> str:
        """Return a PNG or GIF of the run as a data URI."""
        path = self.folder / name
        content = b64encode(path.read_bytes()).decode()
        return f"data:image/{path.suffix[1:]};base64,{content}"

    @property
    def summary(self) -> Mapping[str, Any]:
        """What the run says in words; empty where it says nothing."""
        if not self.has("summary.json"):
            return {}
        summary = read_json(self.folder, "summary.json")
        return summary if isinstance(summary, dict) else {}

    def sections(self, *makers: Callable[["Found"], Section | None]) -> Iterator[Section]:
        """Yield the sections for which the run has something; what fails is noted."""
        for make in makers:
            try:
                section = make(self)
            except RunError as error:
                self.problems.append(str(error))
            except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
                reason = f"{type(error).__name__}: {error}"
                self.problems.append(f"{_title(make)}: not as this version writes it ({reason})")
            else:
                if section is not None:
                    yield section


def _in_words(value: object) -> str:
    return ("no", "yes")[int(value)] if isinstance(value, bool | np.bool_) else cell(value)


def _title(make: Callable[..., Any]) -> str:
    return make.__name__.replace("_", " ")
