"""One exception tree.

Every error that a user can cause derives from `UserError`; the command line turns it into one
message and exit code 2. Anything else is a defect of this package and keeps its traceback.
"""

import difflib
import os
from collections.abc import Iterable


class BoSysidError(Exception):
    """Base of every error raised by this package."""


class UserError(BoSysidError):
    """The study, the model or a recording is wrong; the message says what and how to repair it.

    Attributes:
        key: of the study, or argument, that is wrong; empty where the message itself says which.
    """

    def __init__(self, message: str, *, key: str = "") -> None:
        super().__init__(message)
        self.key = key


class StudyError(UserError):
    """A study file is wrong."""


class RecordingError(UserError):
    """A recording is wrong or cannot be read."""


class ModelError(UserError):
    """A model is wrong or does not compile, or an address matches nothing in it.

    Its key is that which named what the model lacks; empty for the file itself.
    """


class RunError(UserError):
    """A run folder is damaged, belongs to another study, or was written by another version."""


class JobError(BoSysidError):
    """A job failed for no fault of its input: a defect, a process that was lost, a full disk."""


def is_input_error(error: OSError) -> bool:
    """Return whether an input is not there or cannot be read.

    A disk that is full or a folder that cannot be written to is no fault of the input.
    """
    if isinstance(error, PermissionError):
        path = error.filename
        return path is not None and os.path.exists(path) and not os.access(path, os.R_OK)
    wrong = FileNotFoundError | FileExistsError | IsADirectoryError | NotADirectoryError
    return isinstance(error, wrong)


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a hint that names the valid choices nearest to `name`.

    Args:
        name: what was written.
        valid: the valid choices.

    Returns:
        For instance ``"did you mean 'elbow'?"`` or, where nothing is near, ``"valid: 'a', 'b'"``;
        the empty string where there is no valid choice at all.
    """
    choices = sorted({str(v) for v in valid})
    near = difflib.get_close_matches(name, choices, n=3, cutoff=0.5)
    if near:
        return "did you mean " + " or ".join(repr(n) for n in near) + "?"
    if not choices:
        return ""
    shown = ", ".join(repr(c) for c in choices[:12])
    return f"valid: {shown}" + (f" and {len(choices) - 12} more" if len(choices) > 12 else "")


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is Ctrl-C: a compiled module turns it into an `ImportError`."""
    while isinstance(error, ImportError):
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)
