"""MCAP files and ROS bags, through the field's own libraries (group `ros` of dependencies)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.registry import folder_reader, needs, reader, require_content
from bo_sysid.recording.formats.ros import Message, messages_to_table, readable
from bo_sysid.recording.table import RawTable


@reader(".mcap")
def read_mcap(path: Path) -> RawTable:
    """Read the ROS 2 topics of an MCAP file."""
    with needs("ros", path):
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    require_content(path, b"\x89MCAP")
    try:
        with path.open("rb") as file:
            bag = make_reader(file, decoder_factories=[DecoderFactory()])
            summary = bag.get_summary()
            if summary is None:
                raise _truncated(path, "it has no summary at its end")
            kinds = {
                c.topic: summary.schemas[c.schema_id].name if c.schema_id else c.message_encoding
                for c in summary.channels.values()
            }
            wanted = [t for t, k in kinds.items() if readable(k)]
            skipped = {t: k for t, k in kinds.items() if t not in wanted}
            return messages_to_table(_mcap_messages(bag, wanted), str(path), skipped)
    except RecordingError:
        raise
    except McapError as error:
        raise _truncated(path, f"{type(error).__name__}: {error}") from None
    except Exception as error:  # a damaged file can lead the parser to raise anything
        raise _truncated(path, f"{type(error).__name__}: {error}") from error


def _mcap_messages(bag: Any, topics: list[str]) -> Iterator[Message]:
    if topics:
        for schema, channel, message, content in bag.iter_decoded_messages(topics=topics):
            yield Message(channel.topic, schema.name, message.log_time, content)


@reader(".db3", ".bag")
def read_bag(path: Path) -> RawTable:
    """Read a ROS 1 bag, or the SQLite file of a ROS 2 bag with its metadata beside it."""
    if path.suffix == ".db3":
        metadata = path.parent / "metadata.yaml"
        if not metadata.is_file():
            raise RecordingError(
                f"{path}: a part of a ROS 2 bag without its metadata.yaml; keep them in one "
                "folder (`ros2 bag reindex` writes it anew)"
            )
        parts = _parts(metadata)
        if parts > 1:
            raise RecordingError(
                f"{path}: one part of {parts} of a ROS 2 bag, which is read as a whole; name the "
                f"folder, {path.parent}"
            )
        path = path.parent
    return _read(path)


@folder_reader("metadata.yaml")
def read_bag_folder(path: Path) -> tuple[RawTable, ...]:
    """Read the folder of a ROS 2 bag."""
    return (_read(path),)


def _parts(metadata: Path) -> int:
    """Return how many files a bag was split into; 0 where its metadata cannot be read."""
    try:
        found = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        return len(found["rosbag2_bagfile_information"]["relative_file_paths"])
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        return 0  # the bag's reader says what is wrong


def _read(path: Path) -> RawTable:
    with needs("ros", path):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.LATEST)
    try:
        with AnyReader([path], default_typestore=store) as bag:
            kinds = {c.topic: c.msgtype for c in bag.connections}
            wanted = [c for c in bag.connections if readable(c.msgtype)]
            skipped = {t: k for t, k in kinds.items() if not readable(k)}
            for connection in list(wanted):
                if connection.msgtype not in bag.typestore.fielddefs:
                    wanted.remove(connection)
                    skipped[connection.topic] = (
                        f"{connection.msgtype}, whose definition the bag does not hold"
                    )
            return messages_to_table(_bag_messages(bag, wanted), str(path), skipped)
    except RecordingError:
        raise
    except Exception as error:  # a damaged bag can lead the parser to raise anything
        raise _truncated(path, f"{type(error).__name__}: {error}") from error


def _bag_messages(bag: Any, connections: list[Any]) -> Iterator[Message]:
    if connections:
        for connection, received, raw in bag.messages(connections=connections):
            content = bag.deserialize(raw, connection.msgtype)
            yield Message(connection.topic, connection.msgtype, received, content)


def _truncated(path: Path, what: str) -> RecordingError:
    return RecordingError(
        f"{path}: a damaged or truncated bag ({what}). `mcap recover` or `ros2 bag reindex` may "
        "save what is in it"
    )
