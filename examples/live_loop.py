"""Calibrate live, frame by frame: ``live_loop.py drive.mp4 60``, or ``live_loop.py 0 60`` for camera 0."""

import sys
import time

import cv2

import lanebev

if len(sys.argv) != 3:
    sys.exit("usage: python live_loop.py VIDEO_OR_CAMERA_NUMBER DEGREES_OF_VIEW")
source, degrees = sys.argv[1], float(sys.argv[2])
is_camera = source.isdigit()
video = cv2.VideoCapture(int(source) if is_camera else source)
if not video.isOpened():
    sys.exit(f"{source}: expected a video or the number of a camera, got none that opens")
width, height = (int(video.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
session = lanebev.Session(lanebev.Camera.from_fov(degrees, width, height), focal_std=0.05)
while (frame := video.read()[1]) is not None:
    seconds = time.monotonic() if is_camera else video.get(cv2.CAP_PROP_POS_MSEC) / 1000
    result = session(frame, stamp=seconds)
    pitch, std = float(result.extrinsics.pitch), float(result.std.pitch)
    print(f"{result.status.name} pitch {pitch:.4f} +- {std:.4f} rad", *result.reasons, sep="; ")
session.save("state.safetensors")
