"""Where the raw files of public datasets are found.

Files are looked up under ``$BO_SYSID_DATA/<folder>``; where they are not, those that have a stable
public address are downloaded once by pooch and checked against their SHA-256.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from bo_sysid.errors import RecordingError

VARIABLE = "BO_SYSID_DATA"


@dataclass(frozen=True)
class SourceFile:
    """A raw file of a dataset.

    Attributes:
        path: path under the dataset's folder; of a ``.csv`` a gzipped copy (``.csv.gz``) is found
            too.
        url: stable public address; empty where there is none.
        sha256: checksum of what is downloaded.
    """

    path: str
    url: str = ""
    sha256: str = ""


def locate(folder: str, file: SourceFile, how_to_get: str) -> Path:
    """Return where a raw file lies, downloading it if it must.

    Args:
        folder: the dataset's folder under ``$BO_SYSID_DATA``.
        file: the file.
        how_to_get: where the authors publish it and how it is converted, for the message.

    Raises:
        RecordingError: the file is nowhere and cannot be downloaded.
    """
    root = os.environ.get(VARIABLE, "")
    if root:
        gzipped = [f"{file.path}.gz"] if file.path.endswith(".csv") else []  # others are not read
        for name in (file.path, *gzipped):
            candidate = Path(root) / folder / name
            if candidate.is_file():
                return candidate
    looked = f"${VARIABLE} is not set"
    if root:
        looked = f"it is not under ${VARIABLE} ({Path(root) / folder})"
    if not file.url:
        raise RecordingError(f"dataset {folder}: {file.path}: {looked}. {how_to_get}")
    return _download(folder, file, f"{looked}. {how_to_get}")


def _download(folder: str, file: SourceFile, remedy: str) -> Path:
    import pooch

    cache = Path(os.environ.get("BO_SYSID_CACHE", pooch.os_cache("bo_sysid"))) / folder
    try:
        found = pooch.retrieve(
            file.url,
            known_hash=f"sha256:{file.sha256}",
            fname=Path(file.path).name,
            path=cache / Path(file.path).parent,
        )
    except OSError:
        raise RecordingError(
            f"dataset {folder}: {file.path} could not be downloaded from {file.url} (no network?), "
            f"and {remedy}"
        ) from None
    except ValueError as error:  # another checksum
        raise RecordingError(
            f"dataset {folder}: {file.path} could not be downloaded from {file.url}: {error}; "
            f"and {remedy}"
        ) from None
    return Path(found)
