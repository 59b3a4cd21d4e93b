"""The kind of a source by its name and the file system. Imports nothing heavy."""

from pathlib import Path

SCHEMES = ("rtsp", "rtsps", "rtmp", "http", "https", "udp", "rtp", "tcp", "srt")
PIPE = "-"


def is_live(source: str) -> bool:
    """Return whether a source is a camera (``/dev/video0``), a stream's address or a pipe (``-``)."""
    scheme, found, _ = source.partition("://")
    device = source.startswith("/dev/video") or Path(source).is_fifo()
    return source == PIPE or device or bool(found and scheme.lower() in SCHEMES)


def without_login(source: str) -> str:
    """Return an address without the user's name and password; they belong in no message and no report."""
    scheme, found, rest = source.partition("://")
    host, slash, path = rest.partition("/")
    return f"{scheme}{found}{host.rpartition('@')[2]}{slash}{path}" if is_live(source) else source


def is_bag(source: str) -> bool:
    """Return whether a source is an MCAP file, a ROS bag, or the folder of a ROS 2 bag or a file of it."""
    path = Path(source)
    if path.suffix.lower() in (".mcap", ".bag", ".db3") or (path / "metadata.yaml").is_file():
        return True
    return path.is_dir() and {file.suffix for file in path.iterdir()} == {".db3"}
