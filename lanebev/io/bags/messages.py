"""Messages of MCAP files and ROS bags, by topic: those of ROS and of Foxglove."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol

IMAGE_TYPES = (
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "foxglove.CompressedImage",
    "foxglove.RawImage",
    "foxglove_msgs/msg/CompressedImage",
    "foxglove_msgs/msg/RawImage",
    "foxglove.CompressedVideo",
    "foxglove_msgs/msg/CompressedVideo",
)
LENS_TYPES = (
    "sensor_msgs/msg/CameraInfo",
    "foxglove.CameraCalibration",
    "foxglove_msgs/msg/CameraCalibration",
)
VIDEO_TYPES = ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket",)
"""Types of messages with packets of a video, which are not read."""

SPEED_TYPES = {
    "nav_msgs/msg/Odometry": "twist.twist.linear.x",
    "geometry_msgs/msg/Twist": "linear.x",
    "geometry_msgs/msg/TwistStamped": "twist.linear.x",
    "geometry_msgs/msg/TwistWithCovarianceStamped": "twist.twist.linear.x",
    "autoware_vehicle_msgs/msg/VelocityReport": "longitudinal_velocity",
    "autoware_auto_vehicle_msgs/msg/VelocityReport": "longitudinal_velocity",
    "gps_msgs/msg/GPSFix": "speed",
    "gps_common/msg/GPSFix": "speed",
}
"""Types of messages with the vehicle's speed (m/s), and where it is in them."""

_ROS = (("cdr", "ros2msg"), ("ros1", "ros1msg"))  # encodings of messages and of their types
_KNOWN = {*IMAGE_TYPES, *LENS_TYPES, *VIDEO_TYPES, *SPEED_TYPES}


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: name of the topic.
        kind: type of its messages.
        size: number of its messages.
    """

    name: str
    kind: str
    size: int


class Bag(Protocol):
    """A bag that is open.

    Attributes:
        topics: topics of images, lenses, videos and speeds.
    """

    topics: list[Topic]

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Return a topic's messages in the order of their times (ns)."""
        ...


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a ROS bag or an MCAP file for reading.

    Raises:
        ValueError: a library is missing, or the bag cannot be read, also within the ``with`` block.
    """
    for module in ("mcap", "rosbags"):
        if find_spec(module) is None:
            raise ValueError(
                f"bag {path}: expected the library {module}, got none; install it with "
                "pip install 'lanebev[formats]'"
            )
    if path.suffix.lower() == ".db3" or (path.is_dir() and not (path / "metadata.yaml").is_file()):
        raise ValueError(
            f"bag {path}: expected the folder of a ROS 2 bag with its metadata.yaml, got none; give the "
            "folder of the .db3 file, after ros2 bag reindex if it has none"
        )
    try:
        if path.suffix.lower() == ".mcap":
            with open(path, "rb") as file:
                yield _Mcap(file)
        else:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore

            store = get_typestore(Stores.ROS2_HUMBLE)
            with AnyReader([path], default_typestore=store) as reader:
                yield _RosBag(reader)
    except Exception as error:  # two libraries' own, and what damaged bytes make of any decoder
        raise _unreadable(path, error) from error


def message_stamp(message: Any) -> float | None:
    """Return a message's own time (s); None if it is zero or it has none."""
    stamp = message.header.stamp if hasattr(message, "header") else getattr(message, "timestamp", None)
    if stamp is None:
        return None
    seconds = getattr(stamp, "sec", None)
    if seconds is None:
        seconds, fraction = stamp.seconds, stamp.nanos
    else:
        fraction = stamp.nanosec
    return float(seconds + 1e-9 * fraction) if seconds or fraction else None


def _unreadable(path: Path, error: Exception) -> ValueError:
    if isinstance(error, ValueError) and str(error).startswith("bag "):
        return ValueError(str(error))
    if isinstance(error, ValueError) and str(error).startswith("expected "):  # of an image
        return ValueError(f"bag {path}: {error}")
    remedy = " mcap recover writes what is whole of it" if path.suffix.lower() == ".mcap" else ""
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
    return ValueError(f"bag {path}: expected one that can be read, got: {reason[:160]}; is it cut?{remedy}")


def _joined(topics: Iterable[Topic]) -> list[Topic]:
    """Return each topic once, with the messages of all its publishers."""
    sizes: dict[tuple[str, str], int] = {}
    for topic in topics:
        sizes[topic.name, topic.kind] = sizes.get((topic.name, topic.kind), 0) + topic.size
    return [Topic(*key, size) for key, size in sizes.items()]


class _RosBag:
    """A ROS bag by rosbags."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        connections = [each for each in reader.connections if each.msgtype in _KNOWN]
        self.topics = _joined(Topic(each.topic, each.msgtype, each.msgcount) for each in connections)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        connections = [each for each in self._reader.connections if each.topic == topic]
        for connection, time, data in self._reader.messages(connections):
            yield time, self._reader.deserialize(data, connection.msgtype)


class _Mcap:
    """An MCAP file by mcap: messages of ROS by rosbags' types, of Foxglove by protobuf."""

    def __init__(self, file: Any) -> None:
        from mcap.reader import make_reader
        from mcap_protobuf.decoder import DecoderFactory

        factories = [DecoderFactory(), _RosFactory()]
        self._reader = make_reader(file, validate_crcs=True, decoder_factories=factories)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise ValueError("no summary at its end")
        figures = summary.statistics
        topics = []
        for number, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            if schema is not None and (kind := _ros_2_name(schema.name)) in _KNOWN:
                count = figures.channel_message_counts.get(number, 0)
                topics.append(Topic(channel.topic, kind, count))
        self.topics = _joined(topics)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        for _, _, message, decoded in self._reader.iter_decoded_messages([topic]):
            yield message.log_time, decoded


def _ros_2_name(name: str) -> str:
    """Return the name of a type of messages as in ROS 2, where ROS 1 has ``sensor_msgs/Image``."""
    return name if name.count("/") != 1 else name.replace("/", "/msg/")


class _RosFactory:
    """Gives mcap's reader what decodes messages of ROS 1 and 2, as its ``DecoderFactory`` does."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        """Return the decoder of a schema's messages; None if it is unknown."""
        if schema is None or (message_encoding, schema.encoding) not in _ROS:
            return None
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store, name = get_typestore(Stores.EMPTY), _ros_2_name(schema.name)
        store.register(get_types_from_msg(schema.data.decode(), name))
        decode = store.deserialize_cdr if message_encoding == "cdr" else store.deserialize_ros1
        return lambda data: decode(data, name)
