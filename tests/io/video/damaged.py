"""Damaged videos."""

import av
import numpy as np


def write_damaged(path, spoilt, count=16, **options):
    """A video of noise with some packets, in the order of the file, overwritten; their frames' numbers."""
    noise = np.random.default_rng(0)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.options = 64, 48, "yuv420p", options
        for _ in range(count):
            image = noise.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    packets = packets_of(path)
    order = sorted(packet.pts for packet in packets)
    for packet in (packets[i] for i in spoilt):
        overwrite(path, packet.pos, b"\xff" * packet.size)
    return sorted(order.index(packets[i].pts) for i in spoilt)


def packets_of(path):
    """A video's packets, in the order of the file."""
    with av.open(str(path)) as container:
        return [packet for packet in container.demux(video=0) if packet.size]


def overwrite(path, place, junk):
    """Put bytes in the place of a file's own."""
    with path.open("r+b") as file:
        file.seek(place)
        file.write(junk)
