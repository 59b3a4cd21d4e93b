"""Files with several cameras: ``FILE#NAME`` chooses one of them."""

from collections.abc import Callable, Mapping
from pathlib import Path

from lanebev.camera.parameters import CameraParameters
from lanebev.numbers import shown

Readers = Mapping[str, Callable[[], CameraParameters]]
"""A reader for each camera of a file, by its name; the usual one first, and "" for a file of one camera."""

_MOST_NAMES = 8  # in a message


def split_name(path: str | Path) -> tuple[Path, str | None]:
    """Return the path of a camera file, and the name of a camera after its last ``#``; None without one.

    A file whose own name has a ``#`` is one without.
    """
    file, sign, name = str(path).rpartition("#")
    if not (sign and file) or Path(path).exists():
        return Path(path), None
    return Path(file), name


def camera_file(path: str | Path) -> Path:
    """Return the path of a camera file, without the name of a camera after it."""
    return split_name(path)[0]


def chosen(readers: Readers, wanted: str | None, has_usual: bool) -> CameraParameters:
    """Return one camera of a file; the first one if none is named, with a remark if others differ from it.

    Args:
        readers: what reads each of them.
        wanted: name of a camera, None for the first.
        has_usual: whether the first is the one that most people mean.
    """
    if wanted is not None and wanted not in readers:
        names = f"expected one of {_listed(readers)}" if "" not in readers else "expected no name of a camera"
        raise ValueError(f"{names} after #, got {shown(wanted)}")
    name = next(iter(readers)) if wanted is None else wanted
    camera = readers[name]()
    if wanted is not None or not any(_differs(read, camera) for read in readers.values()):
        return camera
    if not has_usual:
        raise ValueError(
            f"expected one camera, got {len(readers)}: {_listed(readers)}; choose one as FILE#{name}"
        )
    words = f"the file has the cameras {_listed(readers)}, of which {name} is taken"
    return camera._replace(remark=f"{words}; choose another as FILE#{[*readers][1]}")


def _differs(read: Callable[[], CameraParameters], camera: CameraParameters) -> bool:
    """Return whether a reader gives another camera, or one that is not known."""
    try:
        return read() != camera
    except ValueError:
        return True


def _listed(readers: Readers) -> str:
    names = [name if name.isprintable() else shown(name) for name in readers]
    return ", ".join([*names[:_MOST_NAMES], *(["..."] if len(names) > _MOST_NAMES else [])])


def unique_names(names: list[str]) -> list[str]:
    """Return the names of a file's cameras, or their numbers if two have the same name."""
    return names if len(set(names)) == len(names) else [str(place) for place in range(len(names))]
