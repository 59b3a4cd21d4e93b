"""Images of a bag's messages, as RGB."""

from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from lanebev.io.images.pixels import is_damaged_jpeg
from lanebev.io.video.decoding import tell_damage

_PLAIN = {  # encoding of ROS to channels, and to OpenCV's conversion to RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),  # OpenCV names the second row's pixels
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
_SEMI_PLANAR = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
"""Encodings of a plane of brightness and one of both colours, of half its width and height."""

_CODECS = {  # formats of Foxglove's CompressedVideo, and ffmpeg's decoders
    "h264": "h264",
    "h265": "hevc",
    "hevc": "hevc",
    "vp9": "vp9",
    "av1": "libdav1d",
}
_JPEG = b"\xff\xd8"  # begins such an image


def is_video(message: Any) -> bool:
    """Return whether a message has a packet of a video, whose image depends on those before."""
    return not hasattr(message, "encoding") and message.format.strip().lower() in _CODECS


class TopicImages:
    """Returns the images of a topic's messages, which are given in their order, as :func:`message_image`."""

    def __init__(self) -> None:
        self._decoder: av.VideoCodecContext | None = None

    def __call__(self, message: Any) -> NDArray[np.uint8]:
        """Return the image of the next message as (H, W, 3) RGB.

        Source: Foxglove's ``CompressedVideo``: a packet holds one frame, and none refers to later ones.
        """
        if not is_video(message):
            return message_image(message)
        if self._decoder is None:
            self._decoder = av.VideoCodecContext.create(_CODECS[message.format.strip().lower()], "r")
            tell_damage(self._decoder)
            self._decoder.flags |= av.codec.context.Flags.low_delay  # else frames come packets later
        try:
            frames = self._decoder.decode(av.Packet(bytes(message.data)))
        except av.error.FFmpegError as error:
            raise ValueError(
                f"expected a packet of {message.format[:40]} that decodes, got: {error.strerror}"
            ) from error
        if not frames or frames[-1].is_corrupt:
            raise ValueError("expected a whole frame, got none; packets before the first key frame have none")
        image: NDArray[np.uint8] = frames[-1].to_ndarray(format="rgb24")
        return image


def message_image(message: Any) -> NDArray[np.uint8]:
    """Return the image of a message as (H, W, 3) RGB.

    Source: ROS's ``sensor_msgs/CompressedImage`` and ``Image`` (``image_encodings.hpp``), Foxglove's
    ``CompressedImage`` and ``RawImage``.
    """
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not hasattr(message, "encoding"):
        found = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if found is None or (bytes(data[:2]) == _JPEG and is_damaged_jpeg(bytes(message.data))):
            raise ValueError(
                f"expected an image of format {message.format[:40]!r} that decodes, got one that does not"
            )
        return np.ascontiguousarray(found[..., ::-1])
    encoding, height, width, step = message.encoding, message.height, message.width, message.step
    is_wide = encoding.endswith("16")  # bits
    encoding = f"{encoding[:-2]}8" if is_wide else encoding
    if encoding in _SEMI_PLANAR:
        height = height * 3 // 2
    elif encoding not in _PLAIN:
        known = ", ".join((*_PLAIN, *_SEMI_PLANAR))
        raise ValueError(
            f"expected an image of {known}, or 16 bits, got {message.encoding[:40]!r}; give the topic of a "
            "camera's images, or convert them to rgb8"
        )
    channels, conversion = _PLAIN.get(encoding) or (1, _SEMI_PLANAR[encoding])
    length = width * channels * (2 if is_wide else 1)
    if not (height > 0 and width > 0 and step >= length and len(data) >= height * step):
        raise ValueError(f"expected {height} rows of {step} bytes, got {len(data)} bytes; is it cut?")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :length])
    if is_wide:
        values = rows.view(">u2" if getattr(message, "is_bigendian", 0) else "<u2")
        rows = (values / 257).round().astype(np.uint8)
    image = rows.reshape(height, width, channels)
    if conversion is None:
        return image
    try:
        converted: NDArray[np.uint8] = cv2.cvtColor(image, conversion)
        return converted
    except cv2.error as error:
        raise ValueError(f"expected an image of {encoding}, got {width} x {height} px of it") from error
