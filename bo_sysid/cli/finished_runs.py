"""Verbs whose finished runs are told again instead of being computed again."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from bo_sysid.runs import Run

if TYPE_CHECKING:
    from bo_sysid.study import Study

_FINISHED = "finished.json"
"""What a finished run was made from beside its study: hashes of files, versions, --strict."""


def once(
    run: Run, study: "Study", compute: Callable[[], None], results: Sequence[str], *, strict: bool
) -> None:
    """Compute into a run folder, unless that was finished with the same files and packages.

    Args:
        run: the folder.
        study: its files and recordings are fingerprinted, and compared with those of the finished
            run.
        compute: writes the results and figures into `run`.
        results: files that a finished run has.
        strict: refuse messy recordings.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    from bo_sysid.study.inputs import holdout_hashes, made_from

    now = made_from(study, strict=strict)
    there = all(run.has(name) for name in (_FINISHED, *results))
    if run.ended and there and run.read_json(_FINISHED) == now | {"held": holdout_hashes(study)}:
        print(
            f"{run.folder}: finished {run.ended}, and nothing that it depends on has changed; this "
            "is what it found. To compute it again, use another --out or remove the folder.\n"
        )
        return
    compute()
    run.write_json(_FINISHED, now | {"held": holdout_hashes(study)})  # not read before the answer
