"""`bo-sysid play`: a learned policy on its plant."""

import argparse
import os
from pathlib import Path

from bo_sysid.cli.common import Verbs


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "play",
        help="evaluate and record a learned policy on the plant",
        description="Evaluate the policy of a run of learn on its simulated plant, record one "
        "episode, and draw a strip of pictures where this machine can render. None of this "
        "counts as a trajectory of the run.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="a run folder of learn")
    parser.add_argument(
        "--policy", type=Path, metavar="FILE", help="another policy (.npz); the run's otherwise"
    )
    parser.add_argument("--episodes", type=int, default=20, metavar="N", help="episodes; 20")
    parser.add_argument("--out", type=Path, metavar="DIR", help="a folder; RUN/play otherwise")
    parser.add_argument("--trust-code", action="store_true", help="run the study's Python files")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Play, and print the returns."""
    failed = _without_graphics()

    from bo_sysid.learn.play import play

    played = play(
        args.folder,
        policy=args.policy,
        episodes=args.episodes,
        out=args.out,
        trust_code=args.trust_code,
    )
    print(played.sentence)
    print(f"Recording: {played.recording}")
    print(f"Pictures: {played.pictures}" if played.pictures else failed or played.not_rendered)


def _without_graphics() -> str:
    """Import MuJoCo, without graphics where those asked for do not work; return why not."""
    asked = os.environ.get("MUJOCO_GL", "")
    try:
        import mujoco  # noqa: F401 - fails where the graphics library is missing
    except Exception as error:  # whatever the library raises
        os.environ["MUJOCO_GL"] = "disable"
        return f"No pictures: MUJOCO_GL={asked} does not work on this machine ({error})."
    return ""
