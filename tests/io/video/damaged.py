"""A damaged video."""

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
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        places = [(packets[i].pos, packets[i].size) for i in spoilt]
        order = sorted(packet.pts for packet in packets)
        numbers = [order.index(packets[i].pts) for i in spoilt]
    data = bytearray(path.read_bytes())
    for start, size in places:
        data[start : start + size] = b"\xff" * size
    path.write_bytes(data)
    return sorted(numbers)
