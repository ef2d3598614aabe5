"""Commitments: what is said about an answer before it is shown.

A commitment is SHA-256(nonce ‖ canonical JSON) with a nonce of 128 bits from the operating system:
it tells nothing about the answer, and no other answer has it.
"""

import hashlib
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bo_sysid.errors import RunError
from bo_sysid.runs import atomic, canonical, plain

_NONCE = 16  # bytes


@dataclass(frozen=True)
class Seal:
    """An answer with the nonce of its commitment.

    Attributes:
        nonce: 32 hexadecimal digits.
        answer: for JSON.
    """

    nonce: str
    answer: Mapping[str, Any]

    @classmethod
    def of(cls, answer: Mapping[str, Any]) -> "Seal":
        """Seal an answer."""
        return cls(secrets.token_hex(_NONCE), plain(answer))

    @property
    def commitment(self) -> str:
        """What is published."""
        return hashlib.sha256(bytes.fromhex(self.nonce) + canonical(self.answer)).hexdigest()

    def plain(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"nonce": self.nonce, "answer": self.answer}

    @classmethod
    def read(cls, path: Path) -> "Seal":
        """Read a seal.

        Raises:
            RunError: the file is no seal.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            seal = cls(data["nonce"], data["answer"])
            if len(bytes.fromhex(seal.nonce)) != _NONCE:
                raise ValueError("the nonce must have 128 bits")
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path}: damaged, not a seal ({error})") from None
        return seal


def write_json(path: Path, value: Any) -> None:
    """Write JSON, whole or not at all."""
    with atomic(path) as beside:
        beside.write_text(json.dumps(plain(value), indent=1) + "\n", encoding="utf-8")


def file_digest(path: Path) -> str:
    """Return SHA-256 of a file.

    Raises:
        RunError: there is no such file.
    """
    if not path.is_file():
        raise RunError(f"{path}: missing; the run is damaged")
    return hashlib.sha256(path.read_bytes()).hexdigest()
