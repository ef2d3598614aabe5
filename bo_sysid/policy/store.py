"""Learned policies: frozen, acting in NumPy, kept in files without pickle."""

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bo_sysid.errors import RunError, UserError
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Normaliser
from bo_sysid.runs import atomic, plain

FORMAT = 1


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy with frozen statistics of its observations.

    Attributes:
        policy: layout of the parameters.
        theta: parameters, float32.
        normaliser: of observations.
        about: what it was learned on, for people and for checks: JSON values by name.
    """

    policy: GaussianPolicy
    theta: Float[np.ndarray, " p"]
    normaliser: Normaliser
    about: Mapping[str, Any] = field(default_factory=dict)

    def act(self, observations: Float[np.ndarray, "n o"]) -> Float[np.ndarray, "n a"]:
        """Return the mean actions, `n x a` in [-1, 1], at `n x o` observations."""
        means = self.policy.network(self.theta, self.normaliser(observations))
        return np.asarray(np.clip(means, -1.0, 1.0))

    def acting(
        self, low: Float[np.ndarray, " a"], high: Float[np.ndarray, " a"]
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return `act` for a machine whose actions from -1 to 1 are commands from `low` to `high`.

        Actions are converted from the command range of the model that the policy was learned on
        (`about["commands"]`), where a repair has given it another one than the machine's.

        Args:
            low: `a` commands at the actions -1, in the actuators' units.
            high: `a` commands at the actions 1.
        """
        own = self.about.get("commands")
        if own is None or (np.array_equal(own["low"], low) and np.array_equal(own["high"], high)):
            return self.act
        least, most = np.asarray(own["low"]), np.asarray(own["high"])

        def act(observations: np.ndarray) -> np.ndarray:
            commands = least + (self.act(observations) + 1.0) / 2.0 * (most - least)
            return np.asarray(np.clip(2.0 * (commands - low) / (high - low) - 1.0, -1.0, 1.0))

        return act

    def require(self, observation_size: int, action_size: int, where: str = "policy") -> None:
        """Refuse a model that this policy was not learned on.

        Raises:
            UserError: the numbers of observations or actions differ.
        """
        own = (self.policy.network.sizes[0], self.policy.actions)
        if own != (observation_size, action_size):
            raise UserError(
                f"{where}: the policy takes {own[0]} observations and gives {own[1]} actions, the "
                f"task has {observation_size} and {action_size}; it was learned on "
                f"{self.about.get('task', 'another task')}"
            )

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` of arrays and a JSON header; it replaces `path` in one step."""
        header = {
            "format": FORMAT,
            "sizes": list(self.policy.network.sizes),
            "clip": self.normaliser.clip,
            "about": dict(self.about),
        }
        write_arrays(
            Path(path),
            {"theta": self.theta, "mean": self.normaliser.mean, "std": self.normaliser.std},
            header,
        )

    @classmethod
    def load(cls, path: str | Path) -> "LearnedPolicy":
        """Read what `save` wrote.

        Raises:
            RunError: the file is missing, damaged, or of another format.
        """
        arrays, header = read_arrays(Path(path))
        if header.get("format") != FORMAT:
            raise RunError(
                f"{path}: not a policy of format {FORMAT} (it says {header.get('format')})"
            )
        needed = {"theta", "mean", "std"} - set(arrays) | {"sizes", "clip", "about"} - set(header)
        if needed:
            raise RunError(f"{path}: damaged: it has no {', '.join(sorted(needed))}")
        policy = GaussianPolicy(Network(tuple(header["sizes"])))
        if arrays["theta"].shape != (policy.size,):
            raise RunError(
                f"{path}: {arrays['theta'].size} parameters for a network of {policy.size}"
            )
        normaliser = Normaliser(arrays["mean"], arrays["std"], float(header["clip"]))
        return cls(policy, arrays["theta"], normaliser, header["about"])

    def export(self, path: str | Path) -> None:
        """Write the deterministic policy as a TorchScript module.

        It maps `n x o` float32 observations, not normalised, to `n x a` actions in [-1, 1], and
        runs wherever libtorch does, without this package.
        """
        from bo_sysid.policy.export import deterministic, write_torchscript

        with atomic(Path(path)) as place:
            write_torchscript(deterministic(self), place)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write arrays and a JSON header into one ``.npz``, atomically."""
    text = np.array(json.dumps(plain(header)))
    with atomic(path) as place, open(place, "wb") as file:
        np.savez(file, allow_pickle=False, _header=text, **arrays)


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `write_arrays` wrote.

    Raises:
        RunError: the file is missing or damaged.
    """
    if not path.is_file():
        raise RunError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        raise RunError(f"{path}: damaged, or no .npz that this package wrote")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("_header")))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise RunError(f"{path}: damaged, or not a file of this package ({error})") from None
    if not isinstance(header, dict):
        raise RunError(f"{path}: damaged, or not a file of this package (its header is no mapping)")
    return arrays, header
