"""Write a spec as a plain MJCF file that stands alone with a folder of assets beside it."""

import ctypes
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import mujoco

from bo_sysid.errors import ModelError
from bo_sysid.mjcf.compiling import mujoco_message, spec_xml
from bo_sysid.runs import atomic


def attached_folders(path: Path) -> tuple[Path, ...]:
    """Return the folders of the models that a model file attaches, at any depth.

    Their files are relative to them, and the spec that MuJoCo makes of it all does not tell where
    that was.

    Args:
        path: an MJCF file that MuJoCo has read.
    """
    seen: list[Path] = []
    folders: list[Path] = []

    def visit(file: Path, home: Path) -> None:
        if file in seen or not file.is_file():
            return
        seen.append(file)
        text = _COMMENT.sub("", file.read_text(encoding="utf-8", errors="replace"))
        for kind, name in _OTHER_MODEL.findall(text):
            other = home / name
            if kind == "include":
                visit(other, home)
            else:
                folders.append(other.parent)
                visit(other, other.parent)

    visit(path, path.parent)
    return tuple(dict.fromkeys(folders))


_COMMENT = re.compile("<!--.*?-->", re.DOTALL)
_OTHER_MODEL = re.compile(r"""<(include|model)\s[^>]*?\bfile\s*=\s*["']([^"']+)["']""")


def write_mjcf(spec: mujoco.MjSpec, path: Path, source: str, attached: Sequence[Path]) -> None:
    """Write a compiled spec to `path` in one step.

    Meshes, textures, height fields and skins are copied into the folder `<stem>_assets` before
    that, and the file is loaded once, as any other program would, before it takes its place.

    Args:
        spec: the compiled spec; its asset paths are changed.
        path: the file to write.
        source: where the model comes from, for messages.
        attached: folders of the models that it attaches (`attached_folders`).

    Raises:
        ModelError: an asset's file cannot be found or is not the only one, or MuJoCo does not read
            what it wrote.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _copy_assets(spec, path.with_name(f"{path.stem}_assets"), source, attached)
    with _all_digits():
        text = _LONG_NUMBER.sub(lambda number: repr(float(number[0])), spec_xml(spec))
    with atomic(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
        try:
            mujoco.MjModel.from_xml_path(str(unfinished))
        except (ValueError, mujoco.FatalError) as error:
            raise ModelError(
                f"{source}: MuJoCo does not read its own export to {path}: {mujoco_message(error)}"
            ) from None


# A double written with 17 digits, between quotes or blanks: repr gives the shortest equal one.
_LONG_NUMBER = re.compile(r'(?<=["\s])-?\d+\.\d{10,}(?:e[+-]?\d+)?(?=["\s])')


@contextmanager
def _all_digits() -> Iterator[None]:
    """Make MuJoCo's writer keep every digit of a double instead of six.

    The library has a switch for that which is not part of its public interface; where it is
    missing, numbers are written with six digits.
    """
    folder = Path(mujoco.__file__).parent
    libraries = [*folder.glob("libmujoco*.so*"), *folder.glob("libmujoco*.dylib")]
    libraries += folder.glob("mujoco.dll")
    library = ctypes.CDLL(str(libraries[0])) if libraries else None
    switch = getattr(library, "_mjPRIVATE__set_xml_precision", None)
    if switch is None:
        yield
        return
    switch(17)
    try:
        yield
    finally:
        switch(6)


def _copy_assets(spec: mujoco.MjSpec, folder: Path, source: str, attached: Sequence[Path]) -> None:
    """Copy every file that the spec names into `folder` and make the spec name the copies."""
    copies: dict[str, str] = {}
    for element, directory in _with_files(spec):
        if element.file:
            element.file = _copy(spec, directory, element.file, folder, copies, source, attached)
        cubes: Any = getattr(element, "cubefiles", ())
        for side, file in enumerate(cubes):
            if file:
                cubes[side] = _copy(spec, directory, file, folder, copies, source, attached)
    spec.compiler.meshdir = spec.compiler.texturedir = ""  # an attached model's is never written
    spec.strippath = False  # it would cut the folder off
    spec.modelfiledir = f"{folder.parent.resolve()}/"


def _with_files(spec: mujoco.MjSpec) -> list[tuple[Any, str]]:
    """Return the elements that may name a file, each with the directory it is relative to."""
    meshes = [*spec.meshes, *spec.hfields, *spec.skins]
    return [(e, e.compiler.meshdir) for e in meshes] + [
        (e, e.compiler.texturedir) for e in spec.textures
    ]


def _copy(
    spec: mujoco.MjSpec,
    directory: str,
    file: str,
    folder: Path,
    copies: dict[str, str],
    source: str,
    attached: Sequence[Path],
) -> str:
    """Copy one asset; return its path relative to the folder's parent."""
    key = str(PurePosixPath(directory) / file)
    if key not in copies:
        content = _content(spec, directory, file, source, attached)
        name = PurePosixPath(file).name
        taken = {PurePosixPath(c).name for c in copies.values()}
        number = 1
        while name in taken:
            number += 1
            name = f"{number}_{PurePosixPath(file).name}"
        with atomic(folder / name) as unfinished:
            unfinished.write_bytes(content)
        copies[key] = f"{folder.name}/{name}"
        spec.assets[copies[key]] = content  # an attached model's is looked for in its own folder
    return copies[key]


def _content(
    spec: mujoco.MjSpec, directory: str, file: str, source: str, attached: Sequence[Path]
) -> bytes:
    """Return an asset's content from memory or from disk."""
    name = PurePosixPath(file).name
    stripped = [PurePosixPath(directory) / name, PurePosixPath(name)]  # as `strippath` has it
    places = [PurePosixPath(directory) / file, PurePosixPath(file), *stripped]
    for place in map(str, places):
        if place in spec.assets:
            content = spec.assets[place]
            return content.encode() if isinstance(content, str) else bytes(content)
    for place in map(str, places):
        found = [
            p for f in (Path(spec.modelfiledir or "."), *attached) if (p := f / place).is_file()
        ]
        contents = {p.read_bytes() for p in found}
        if len(contents) > 1:
            several = ", ".join(map(str, found))
            raise ModelError(
                f"{source}: asset {place!r} differs between {several}; give each a name of its own"
            )
        if contents:
            return contents.pop()
    raise ModelError(f"{source}: asset {file!r} is not at {directory or '.'} any more")
