"""Videos and folders as recorders leave them: mirrored, damaged, without times, named by seconds."""

import struct
from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lanebev.io.images.names import in_natural_order, natural_order, times_from_names
from lanebev.io.lanes import lane_files
from lanebev.io.opening import open_source
from lanebev.io.video.decoding import decoded, displayed, packets
from lanebev.io.video.remarks import missing_remark
from lanebev.io.video.writer import VideoWriter
from tests.io.video.damaged import overwrite, packets_of

SIZE = (48, 64)


def _gradient(seed=0):
    """A picture that looks different in all eight orientations."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([3 * x + 20, 4 * y + 20, 60 * ((x < 20) & (y < 30)) + seed], axis=-1).astype(np.uint8)


def _encode(path, codec="libx264", count=20, fps=10, images=None, **options):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps)
        stream.height, stream.width = SIZE
        stream.pix_fmt, stream.options, stream.bit_rate = "yuv420p", options, 2_000_000
        for i in range(count):
            image = np.full((*SIZE, 3), 10 * i + 20, np.uint8) if images is None else images[i]
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = i, Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


# display matrices

TURNS = {  # (a, b, c, d) of the matrix: what is shown of a stored image
    (1, 0, 0, 1): lambda image: image,
    (-1, 0, 0, 1): lambda image: image[:, ::-1],
    (1, 0, 0, -1): lambda image: image[::-1],
    (-1, 0, 0, -1): lambda image: image[::-1, ::-1],
    (0, 1, -1, 0): lambda image: np.rot90(image, -1),  # a quarter clockwise
    (0, -1, 1, 0): np.rot90,
    (0, 1, 1, 0): lambda image: image.transpose(1, 0, 2),
    (0, -1, -1, 0): lambda image: np.rot90(image, 2).transpose(1, 0, 2),
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_display_matrix_turns_and_mirrors(tmp_path, turn):
    with VideoWriter(tmp_path / "v.mp4", Fraction(10), crf=1) as writer:
        for _ in range(3):
            writer.write(_gradient())
    a, b, c, d = (65536 * value for value in turn)
    data = (tmp_path / "v.mp4").read_bytes()
    start = data.index(b"tkhd") + 4 + 40  # version and flags, 20 bytes of times, 16 of layer and volume
    assert struct.unpack(">9i", data[start : start + 36])[0] == 65536
    shift = (64 if a < 0 or c < 0 else 0, 48 if b < 0 or d < 0 else 0)
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 65536 * shift[0], 65536 * shift[1], 1 << 30)
    (tmp_path / "v.mp4").write_bytes(data[:start] + matrix + data[start + 36 :])
    expected = TURNS[turn](_gradient())
    source = open_source(str(tmp_path / "v.mp4"))
    assert source.image_size == expected.shape[:2]
    for frame in source:
        assert np.abs(frame.image.astype(int) - expected).mean() < 6


def test_odd_angles_are_brought_to_right_ones():
    image = _gradient()
    c, s = round(65536 * np.cos(0.3)), round(65536 * np.sin(0.3))
    np.testing.assert_array_equal(displayed(image, (c, s, 0, -s, c, 0, 0, 0, 1 << 30)), image)
    turned = displayed(image, (s, c, 0, -c, s, 0, 0, 0, 1 << 30))
    np.testing.assert_array_equal(turned, np.rot90(image, -1))


# damage


def _noise(count=12):
    noise = np.random.default_rng(0)
    return noise.integers(0, 255, (count, *SIZE, 3), dtype=np.uint8)


def _damage_the_fourth(path):
    packet = packets_of(path)[3]
    overwrite(path, packet.pos + 8 + packet.size // 2, bytes(40))  # 8: AVI's chunk header


def test_a_frame_that_the_decoder_marks_as_damaged_is_a_frame_without_image(tmp_path):
    path = _encode(tmp_path / "v.avi", "mpeg4", images=_noise(), count=12, g="100", sc_threshold="1000000000")
    _damage_the_fourth(path)
    with av.open(str(path)) as container:
        marked = [frame.is_corrupt for frame in container.decode(video=0)]
    assert marked == [i == 3 for i in range(12)]  # concealed, and marked
    source = open_source(str(path))
    frames = list(source)
    assert source.count == len(frames) == 12
    assert [frame.image is None for frame in frames] == marked
    assert frames[3].problem == "expected a whole frame, got: one that the decoder marks as damaged"
    assert frames[4].problem == "up to the next key frame, images may show a lost frame's damage"
    assert not any(frame.problem for frame in [*frames[:3], *frames[5:]])
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(12) / 10, atol=1e-9)


def test_damage_ends_at_the_next_key_frame(tmp_path):
    path = _encode(tmp_path / "v.avi", "mpeg4", images=_noise(), count=12, g="4", sc_threshold="1000000000")
    _damage_the_fourth(path)
    frames = list(open_source(str(path)))
    assert [frame.number for frame in frames if frame.problem] == [3]


@pytest.mark.parametrize(
    ("codec", "suffix", "share", "options"),
    [
        ("libx264", "mp4", 0.5, {"bf": "0"}),  # by several threads of slices too
        ("libx265", "mp4", 0.0, {"x265-params": "bframes=0:log-level=none"}),
        ("wmv1", "avi", 0.5, {}),
        ("wmv2", "avi", 0.5, {}),
        ("msmpeg4v2", "avi", 0.5, {}),
        ("msmpeg4", "avi", 0.5, {}),
    ],
)
def test_damage_that_decoders_do_not_mark_by_themselves_is_noticed(tmp_path, codec, suffix, share, options):
    path = _encode(tmp_path / f"v.{suffix}", codec, images=_noise(), count=12, g="100", **options)
    packet = packets_of(path)[3]
    overwrite(path, packet.pos + 6 + round(share * packet.size), b"\xff" * 200)  # 6: HEVC's length and header
    frames = list(open_source(str(path)))
    assert all(frame.image is not None for frame in frames[:3])
    assert frames[3].image is None
    assert frames[3].problem.startswith("expected a whole frame, got: ")


def test_packets_that_a_transport_stream_lost_are_noticed(tmp_path):
    """The frames after them are built on ones that are not there."""
    path = _encode(tmp_path / "v.ts", images=_noise(30), count=30, g="15", bf="0", sc_threshold="0")
    whole = list(open_source(str(path)))
    assert not any(frame.problem for frame in whole)
    place, data = packets_of(path)[5].pos, path.read_bytes()
    path.write_bytes(data[: place + 188] + data[place + 4 * 188 :])  # of 188 bytes each
    source = open_source(str(path))
    problems = {round(10 * frame.time): frame.problem for frame in source if frame.problem}
    assert min(problems) in (4, 5)
    assert "up to the next key frame, images may show a lost frame's damage" in problems.values()
    assert max(problems) < 15


class _Doubted:
    """A packet that the container marks as damaged."""

    is_corrupt = True

    def __init__(self, packet):
        self.packet = packet

    def __getattr__(self, name):
        return getattr(self.packet, name)


@pytest.mark.parametrize(("number", "lost"), [(5, [5]), (15, [])])  # of a key frame nothing is missing
def test_a_frame_in_a_packet_that_the_container_marks_is_lost(tmp_path, monkeypatch, number, lost):
    path = _encode(tmp_path / "v.ts", images=_noise(30), count=30, g="15", bf="0", sc_threshold="0")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        read = [_Doubted(each) if i == number else each for i, each in enumerate(packets(container, stream))]
        monkeypatch.setattr("lanebev.io.video.decoding.packets", lambda *_: read)
        frames = [frame for _, frame in decoded(container, stream)]
    assert [i for i, frame in enumerate(frames) if isinstance(frame, str)] == lost
    assert len(frames) == 30


def test_frames_that_a_transport_stream_lost_as_a_whole_are_counted(tmp_path):
    path = _encode(tmp_path / "v.ts", images=_noise(30), count=30, g="15", bf="0")
    found, data = packets_of(path), path.read_bytes()
    path.write_bytes(data[: found[5].pos] + data[found[7].pos :])
    problem = open_source(str(path)).problem
    assert (
        "its times leave out 2 frames; if they were lost, images after such a gap may be damaged" in problem
    )
    assert missing_remark("mpegts", [0, 3, 6, 9]) == missing_remark("mov,mp4", [0, 3, 9, 12]) == ""
    assert missing_remark("mpegts", [0, 3, 8, 11, 18, 21, 29]) == ""  # steps that vary
    reordered = [0, *(first + step for first in range(0, 30, 3) for step in (3, 1, 2))]
    assert missing_remark("mpegts", reordered) == missing_remark("mpegts", reordered[:-2]) == ""  # cut off
    assert "leave out 3 frames" in missing_remark("mpegts", reordered[:7] + reordered[10:])


# streams without times, B-frames


@pytest.mark.parametrize("stated", [10, 12.5, None])
@pytest.mark.parametrize("options", [{"bf": "0"}, {"bf": "3", "b_strategy": "0"}])
def test_a_raw_stream_has_the_stated_frame_rate(tmp_path, stated, options):
    path = _encode(tmp_path / "v.h264", fps=20, **options)
    source = open_source(str(path), None if stated is None else Fraction(stated))
    assert source.fps == (stated or 20)  # x264 writes it into the stream; other encoders do not
    assert ("it has no times, and is taken for 20 frames" in source.problem) == (stated is None)
    frames = list(source)
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(20) / float(source.fps))
    assert [round((frame.image.mean() - 20) / 10) for frame in frames] == list(range(20))


def test_a_video_that_has_times_says_that_another_rate_is_not_used(tmp_path):
    path = _encode(tmp_path / "v.mp4")
    assert open_source(str(path), Fraction(10)).problem == ""
    source = open_source(str(path), Fraction(30))
    assert source.fps == 10
    assert source.problem.endswith("v.mp4: its own 10 frames per second are used, not --fps 30")


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx264", {"bf": "2", "b_strategy": "0"}),
        ("libx264", {"bf": "3", "b_strategy": "0", "b-pyramid": "normal"}),
        ("libx264", {"bf": "0"}),
        ("mpeg4", {"bf": "2", "b_strategy": "0"}),
    ],
)
@pytest.mark.parametrize("suffix", ["avi", "mkv"])
def test_b_frames_come_in_order_and_at_their_times(tmp_path, codec, options, suffix):
    frames = list(open_source(str(_encode(tmp_path / f"v.{suffix}", codec, **options))))
    assert [round((frame.image.mean() - 20) / 10) for frame in frames] == list(range(20))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(20) / 10, atol=1e-3)
    assert not any(frame.problem for frame in frames)


# names


def test_decimal_seconds_are_in_order_of_time():
    times = [1700000000 + i / 20 for i in range(24)]
    names = [f"img/{time}.jpg" for time in times]
    assert in_natural_order(names[::-1]) == names
    np.testing.assert_allclose(times_from_names(names), np.arange(24) / 20, atol=1e-9)
    small = [f"{i / 20}.png" for i in range(50)]
    assert in_natural_order(reversed(small)) == small
    assert times_from_names(small) == ()  # seconds or versions: not without doubt
    without_zeros = [f"{i / 10:g}.png" for i in range(24)]  # 0.png, 0.1.png, ..., 1.png, 1.1.png
    assert in_natural_order(reversed(without_zeros)) == without_zeros


@pytest.mark.parametrize(
    "names",
    [
        ["1.9.jpg", "1.10.jpg", "1.11.jpg", "2.1.jpg"],  # sections: a fraction ends with a zero
        ["5.jpg", "17.jpg", "100.jpg"],
        ["v1.2.3.jpg", "v1.2.10.jpg"],
        ["1700000000.99999999.jpg", "1700000000.149999999.jpg"],  # nanoseconds without leading zeros
        ["a/2/10.jpg", "a/10/2.jpg"],
        ["00810.MP4/1.jpg", "00810.MP4/10.jpg"],
        ["image.jpg", "image 2.jpg", "image 10.jpg"],  # copies
        ["frame.png", "frame1.png", "frame02.png"],
        ["0000.jpg", "0009.jpg", "000a.jpg", "000f.jpg", "0010.jpg"],  # hexadecimal
        ["2/0009.JPG", "2/000A.JPG", "10/0000.JPG"],
    ],
)
def test_other_numbers_are_in_natural_order(names):
    assert in_natural_order(names[::-1]) == names


@given(st.lists(st.integers(0, 3 * 10**6), unique=True, min_size=1, max_size=30))
def test_any_floats_of_seconds_are_sorted_by_value(milliseconds):
    stamps = [1_600_000_000 + value / 1000 for value in milliseconds]
    names = in_natural_order(f"a/{stamp}.png" for stamp in stamps)
    shown = [float(name[2:-4]) for name in names]
    assert shown == sorted(stamps)


@given(st.lists(st.text(max_size=12), max_size=8))
def test_any_names_are_sorted_the_same_way_twice(names):
    once = in_natural_order(names)
    assert sorted(once) == sorted(names)
    assert sorted(names, key=natural_order) is not None
    assert in_natural_order(once) == once


@pytest.mark.parametrize(
    ("form", "scale"),
    [
        ("{:d}.png", 10**9),
        ("{:d}.png", 10**6),
        ("left-{:d}.jpg", 10**3),
        ("n015__CAM_FRONT__{:d}.jpg", 10**6),
        ("{:d}.jpg", 10**8),  # OpenLane's
    ],
)
def test_names_of_whole_numbers_since_1970_state_times(form, scale):
    seconds = [1532402927, 1532402927.5, 1532402928.25]
    names = [form.format(round(value * scale)) for value in seconds]
    np.testing.assert_allclose(times_from_names(names), [0, 0.5, 1.25], atol=1e-6)


@pytest.mark.parametrize("separator", "._-")
def test_names_of_seconds_and_nanoseconds_state_times(separator):
    names = [f"1532402927{separator}{value:09d}.png" for value in (5_000_000, 105_000_000, 999_000_000)]
    np.testing.assert_allclose(times_from_names(names), [0, 0.1, 0.994], atol=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        ["1532402927612460.jpg"],  # one image
        ["0000000000000001.jpg", "0000000000000002.jpg"],  # counters
        ["20230615123456789.jpg", "20230615123456822.jpg"],  # date and time of day
        ["2018072411-22.jpg", "2018072411-23.jpg"],
        ["1532402927612460.jpg", "1532402927612460.jpg"],  # stands still
        ["1532402928612460.jpg", "1532402927612460.jpg"],  # backwards
        ["1532402927612460.jpg", "1532492927612460.jpg"],  # a day later
        ["1532402927612460.jpg", "1532402927.7.jpg"],
        ["a.jpg", "b.jpg"],
    ],
)
def test_names_that_may_be_anything_state_no_times(names):
    assert times_from_names(names) == ()


def _images(folder, names):
    folder.mkdir()
    for name in names:
        Image.fromarray(_gradient()).save(folder / name)
    return str(folder)


def test_images_named_by_time_have_their_times(tmp_path):
    times = [1700000000.0, 1700000000.05, 1700000000.1, 1700000000.2]  # one is missing
    folder = _images(tmp_path / "a", [f"{time}.png" for time in times])
    source = open_source(folder)
    assert float(source.fps) == pytest.approx(20, rel=1e-4)
    frames = list(source)
    np.testing.assert_allclose([frame.time for frame in frames], [0, 0.05, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose([frame.dt for frame in frames], [0.05, 0.05, 0.05, 0.1], atol=1e-6)
    assert source.problem == ""
    stated = open_source(folder, Fraction(20))
    assert [frame.time for frame in stated] == [0, 0.05, 0.1, 0.15]  # stated, as ever
    assert stated.problem == ""
    assert open_source(folder, Fraction(5)).problem.endswith(
        "its names state 20 frames per second, --fps 5 was given"
    )
    assert open_source(_images(tmp_path / "b", ["1.png", "2.png"])).fps == 30


def test_lane_files_are_in_the_order_of_their_images(tmp_path):
    names = [f"{1700000000 + i / 20}.lines.txt" for i in range(12)]
    for name in names:
        (tmp_path / name).write_text("")
    assert [file.name for file in lane_files(tmp_path)] == names
